"""One run of the program, with progress, messages and cancel. No QGIS here."""

import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time

from . import environment

#: `filters.modelclassifier: 1,234 of 5,678 points (22 %), ...`
_PROGRESS = re.compile(r"^(?P<label>.+?): [\d,]+ of [\d,]+ .*?\((?P<percent>\d+) %\)")
_WINDOWS = sys.platform == "win32"
#: Seconds that a canceled run has to clean up, before it is ended by force.
PATIENCE = 20.0


class Failed(Exception):
    """Raised where the program ended with an error; the text is its message."""


def run(program, arguments, feedback, text=None, quiet=False):
    """Run the program to its end and return what it printed on standard output.

    Parameters
    ----------
    program : str
    arguments : list of str
    feedback : QgsProcessingFeedback
    text : str, optional
        For standard input.
    quiet : bool
        Leave what it prints on standard output out of the log.

    Raises
    ------
    Failed
        If it ends with an error, or was canceled.
    """
    feedback.pushCommandInfo(" ".join(_quoted(word) for word in ["pdal-stages", *arguments]))
    process = _start(program, arguments, text is not None)
    lines = queue.Queue()
    readers = [
        threading.Thread(target=_read, args=(stream, name, lines), daemon=True)
        for stream, name in ((process.stdout, "out"), (process.stderr, "err"))
    ]
    for reader in readers:
        reader.start()
    if text is not None:
        threading.Thread(target=_write, args=(process.stdin, text), daemon=True).start()
    printed, messages, open_streams, canceled = [], [], len(readers), None
    while open_streams:
        if feedback.isCanceled():
            if canceled is None:
                canceled = time.monotonic()
                _interrupt(process)
                feedback.pushInfo("Canceling: the run cleans up ...")
            elif time.monotonic() - canceled >= PATIENCE:
                _kill(process)
        try:
            name, line = lines.get(timeout=0.1)
        except queue.Empty:
            continue
        if line is None:
            open_streams -= 1
        elif name == "out":
            printed.append(line)
            if not quiet:
                feedback.pushInfo(line)
        else:
            _tell(line, messages, feedback)
    code = process.wait()
    for stream in (process.stdout, process.stderr):
        stream.close()
    if canceled or feedback.isCanceled():
        raise Failed(
            "Canceled; no output was written. A hidden folder that may be left is removed by the "
            "next run there."
        )
    if code:
        raise Failed(messages[-1] if messages else f"pdal-stages ended with exit code {code}.")
    return "\n".join(printed)


def _start(program, arguments, with_input):
    """Start the program in a session of its own, so that its workers end with it."""
    session = {} if _WINDOWS else {"start_new_session": True}
    try:
        return subprocess.Popen(
            [program, *arguments],
            env=environment.variables(program),
            stdin=subprocess.PIPE if with_input else subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            **session,
            **environment.without_window(),
        )
    except OSError as error:
        raise Failed(f"{program} cannot be run: {error}. {environment.INSTALL}.") from None


def _tell(line, messages, feedback):
    progress = _PROGRESS.match(line)
    if progress:
        feedback.setProgressText(progress["label"])
        feedback.setProgress(float(progress["percent"]))
        return
    messages.append(line.removeprefix("pdal-stages: "))
    if line.startswith("pdal-stages: "):
        feedback.pushWarning(line)
    else:
        feedback.pushInfo(line)


def _read(stream, name, lines):
    for raw in iter(stream.readline, b""):
        line = raw.decode("utf-8", errors="replace").rstrip()
        if line:
            lines.put((name, line))
    lines.put((name, None))


def _write(stream, text):
    try:
        stream.write(text.encode("utf-8"))
        stream.close()
    except OSError:
        pass  # it ended before it read everything, and says why


def _interrupt(process):
    """Interrupt the program and its workers, as Ctrl-C does."""
    try:
        if _WINDOWS:
            process.send_signal(signal.CTRL_BREAK_EVENT)
        else:
            os.killpg(process.pid, signal.SIGINT)
    except OSError:
        pass


def _kill(process):
    try:
        if _WINDOWS:
            process.kill()
        else:
            os.killpg(process.pid, signal.SIGKILL)
    except OSError:
        pass


def _quoted(word):
    return (
        word if re.fullmatch(r"[\w@%+=:,./~#-]+", word) else "'" + word.replace("'", "'\\''") + "'"
    )
