"""What commands of the matrix open for writing, make, rename, remove and start, as Python's audit hooks report it.

Every command that a :class:`~robustness_kit.Cell` runs is watched, and every Python that it starts. What it changes is what
it was asked for, or lies in a hidden folder of its own. What PDAL and libraries write without Python, ``test_robust_files.py`` watches.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
from collections.abc import Iterable
from pathlib import Path

#: Ours: hidden folders beside outputs, notes of tiled runs and of their pace, compiled kernels, temporary folders; and the system's.
OWN = (
    r"/\.pdal-stages-partial-[^/]+(/|$)", r"/\.pdal-stages(/|$)", r"/\.[^/]+\.cells(/|$)", r"/__pycache__(/|$)",
    r"^/(tmp|var/tmp)/pdal-stages-[^/]+(/|$)", r"^/dev/(null|tty|shm/(sem\.)?[\w.-]+)$", r"^/proc/",
    r"/pdal-stages(/measured\.json)?$", r"\.nb[ic]", r"^/tmp/tmp\w+(/|$)", r"^/tmp/[a-z0-9_]{8}$",
)  # fmt: skip
#: Programs that commands may start.
PROGRAMS = r"(python[\d.]*|pdal|uname|sh)$"
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_ONE = {"os.remove": 1, "os.mkdir": 2, "os.rmdir": 1, "os.truncate": None, "os.chmod": None, "os.chown": None}  # fmt: skip
_seen: list[str] = []
_on = False
_descriptor = -1


def _hook(event: str, arguments: tuple) -> None:
    if not _on and _descriptor < 0:
        return
    found: list[str] = []
    if event == "open":
        if isinstance(arguments[2], int) and arguments[2] & _WRITES:
            found = [_path(arguments[0])]
    elif event in ("os.rename", "os.link"):
        found = [_path(arguments[0], arguments[2]), _path(arguments[1], arguments[3])]
    elif event == "os.symlink":
        found = [_path(arguments[1], arguments[2])]
    elif event in _ONE:
        at = _ONE[event]
        found = [_path(arguments[0], -1 if at is None else arguments[at])]
    elif event in ("subprocess.Popen", "os.posix_spawn", "os.exec", "os.system"):
        found = [f"program {os.fsdecode(arguments[0] or arguments[1][0])}"]
    for line in filter(None, found):
        if _descriptor >= 0:
            os.write(_descriptor, (line.replace("\n", "\\n") + "\n").encode(errors="surrogateescape"))
        else:
            _seen.append(line.replace("\n", "\\n"))


def _path(name: object, folder: object = -1) -> str:
    """An absolute name; nothing of what is open already."""
    if not isinstance(name, str | bytes | os.PathLike):
        return ""
    try:
        base = (
            os.readlink(f"/proc/self/fd/{folder}") if isinstance(folder, int) and folder >= 0 else os.getcwd()
        )
    except OSError:
        base = "/"
    return os.path.normpath(os.path.join(base, os.fsdecode(name)))


def report_to(file: str) -> None:
    """In a process that was started: report to a file until it ends."""
    global _descriptor
    _descriptor = os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    sys.addaudithook(_hook)


class Watch:
    """Watches what runs inside ``with``; :attr:`beyond` says afterwards what was neither asked for nor the program's own."""

    _put_up = False

    def __init__(self, words: Iterable[object], folder: Path, log: Path) -> None:
        self.words, self.folder, self.log = [str(word) for word in words], Path(folder), log
        self.asked: list[re.Pattern[str]] = []
        self.beyond: list[str] = []

    def environment(self, given: dict[str, str | None]) -> dict[str, str | None]:
        """What Python processes need that are to be watched too."""
        first = str(Path(__file__).resolve().parent / "audited")
        return {
            **given,
            "PYTHONPATH": os.pathsep.join(filter(None, [first, given.get("PYTHONPATH")])),
            "PDAL_STAGES_AUDIT": str(self.log),
        }

    def __enter__(self) -> Watch:
        global _on
        if not Watch._put_up:
            sys.addaudithook(_hook)  # which cannot be taken down
            Watch._put_up = True
        self.log.unlink(missing_ok=True)
        self.log.touch(0o666)
        self.log.chmod(0o666)
        names = _names(self.words, self.folder)
        names |= {os.path.realpath(self.folder / name) for name in names}  # a link is followed
        self.asked = [_named(name, self.folder) for name in names]
        _seen.clear()
        _on = True
        return self

    def __exit__(self, *_: object) -> None:
        global _on
        _on = False
        lines = [*_seen, *self.log.read_text(errors="surrogateescape").splitlines()]
        self.log.unlink()
        self.beyond = sorted({line for line in lines if not self._fine(line)})

    def _fine(self, line: str) -> bool:
        if line.startswith("program "):
            return bool(re.search(PROGRAMS, line))
        real = os.path.realpath(line)
        return (
            any(re.search(pattern, line) for pattern in OWN)
            or any(one.fullmatch(name) for one in self.asked for name in (line, real))
            or line == str(self.log)
        )


def _names(words: list[str], folder: Path) -> set[str]:
    """Texts that may name files: words of the command, their parts, and texts in the files of JSON that they name."""
    found = set(words)
    for word in words:
        found.update(re.split(r"[=,|]", word))
        path = folder / word
        try:
            if (
                path.is_file()
                and path.stat().st_size < 1_000_000
                and not path.name.endswith((".las", ".laz"))
            ):
                text = path.read_text(errors="replace")
                for part in re.findall(r'"(?:[^"\\]|\\.)*"', text):
                    with contextlib.suppress(ValueError):
                        found.add(str(json.loads(part)))
        except OSError:
            pass
    return {name for name in found if name and "\0" not in name and _is_a_name(name)}


def _is_a_name(text: str) -> bool:
    try:
        return bool(os.fsencode(text))
    except UnicodeEncodeError:  # half a pair
        return False


def _named(name: str, folder: Path) -> re.Pattern[str]:
    """Files that a name stands for: '#' is for numbers or names, a folder for what lies in it, a log for its own."""
    path = os.path.normpath(os.path.join(folder, name))
    pattern = re.escape(path).replace(r"\#", r"[^/]+")
    if name.endswith("/") or os.path.isdir(path):
        return re.compile(f"{pattern}(/[^/]+)?")
    stem = re.escape(os.path.splitext(path)[0]).replace(r"\#", r"[^/]+")
    return re.compile(rf"{pattern}|{stem}(_\w+)?\.(qml|shx|dbf|prj|cpg|shp|fgb|geojson)")
