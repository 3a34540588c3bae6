"""Processes of our own: results and errors come back, a dead one is told from a failing call."""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest
from processes import printed, python

from pdal_stages.base.errors import StageError
from pdal_stages.base.processes import ProcessEnded, PythonProcess


class Unpicklable(Exception):
    def __init__(self, first, second):
        super().__init__(lambda: (first, second))


def fails_with_what_no_process_can_send():
    raise Unpicklable(1, 2)


def prints_and_returns(number):
    os.system("echo to standard output, which is no result")
    print("neither is this")
    return number + 1


def refuses():
    raise StageError("it is wrong", found="this", cure="Do that")


def test_results_and_errors():
    with PythonProcess({"OF_MINE": "7"}) as process:
        assert process.call(prints_and_returns, 1) == 2
        assert process.call(os.getenv, "OF_MINE") == "7" and process.call(os.getpid) == process.pid
        with pytest.raises(StageError, match=r"it is wrong \(found this\)\. Do that"):
            process.call(refuses)
        with pytest.raises(RuntimeError, match="Unpicklable"):
            process.call(fails_with_what_no_process_can_send)
        with pytest.raises(ModuleNotFoundError):
            process.call(__import__, "no_such_module")
        assert process.call(abs, -3) == 3


def test_a_killed_process_is_told_from_a_failing_call():
    with PythonProcess() as process:
        threading.Timer(0.5, os.kill, (process.pid, signal.SIGKILL)).start()
        with pytest.raises(ProcessEnded, match="its worker process died"):
            process.call(time.sleep, 60)
        with pytest.raises(ProcessEnded):
            process.call(abs, -3)


@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_it_ends_with_its_parent_and_needs_no_main_guard(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import os, time\n"
        "from pdal_stages.base.processes import PythonProcess\n"
        "process = PythonProcess()\n"
        "print(process.call(os.getpid), flush=True)\n"
        "os._exit(0)\n"
    )
    status = Path(f"/proc/{int(printed(sys.executable, script))}/stat")
    for _ in range(100):
        try:
            if status.read_text().rpartition(")")[2].split()[0] == "Z":
                return
        except OSError:
            return
        time.sleep(0.1)
    pytest.fail("the process lives on")


def test_the_current_folder_holds_no_modules_for_it(tmp_path):
    (tmp_path / "json.py").write_text("raise SystemExit('taken from the current folder')")
    code = (
        "import sys; sys.path = [p for p in sys.path if p]\n"
        "from pdal_stages.base.processes import PythonProcess\n"
        "with PythonProcess() as process: print(process.call(abs, -3))"
    )
    assert python(code, cwd=tmp_path, env={"PYTHONSAFEPATH": "1"}) == "3\n"
