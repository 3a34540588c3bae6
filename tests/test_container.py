"""The container, without Docker: its file is a list of the script's steps, and the script starts with the right kernels."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = ROOT / "scripts" / "container"
FILES = [
    ROOT / name for name in ("Dockerfile", "compose.yaml", ".dockerignore", "scripts/container")
]


def instructions():
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    return [tuple(line.split(maxsplit=1)) for line in lines if line and not line.startswith("#")]


def test_every_run_line_is_one_step_of_the_script_and_every_step_is_run():
    run = [rest for word, rest in instructions() if word == "RUN"]
    steps = [re.fullmatch(r"(?:/opt/pdal_stages/)?scripts/container (\w+)", line) for line in run]
    assert all(steps), run
    named = re.search(r"^  ([\w| ]+)\)\n    mkdir -p", SCRIPT.read_text(), re.MULTILINE)[1].split(
        " | "
    )
    assert [step[1] for step in steps] == named
    for step in named:
        assert f"\n{step}() {{\n" in SCRIPT.read_text(), step
        assert f"\n#   scripts/container {step} " in SCRIPT.read_text(), step
    assert subprocess.run(["bash", "-n", SCRIPT], check=False).returncode == 0
    assert os.access(SCRIPT, os.X_OK)


# ---- starting ----------------------------------------------------------------------------------------------------


@pytest.fixture
def image(tmp_path):
    """Return what the build leaves, with programs that tell how they were started."""
    root = tmp_path / "image"
    (root / "scripts").mkdir(parents=True)
    for name in ("container", "lib.sh"):
        shutil.copy(ROOT / "scripts" / name, root / "scripts" / name)
    (root / ".venv/bin").mkdir(parents=True)
    (root / ".kernels/one").mkdir(parents=True)
    (root / ".kernels/one/kernel.nbi").write_text("compiled")
    (root / ".build").write_text("0123\n")
    program = root / ".venv/bin/pdal-stages"
    program.write_text(
        '#!/bin/sh\n[ -z "$FAIL" ] || [ "$1" != warmup ] || exit 1\n'
        f'echo "$1 ${{NUMBA_CPU_NAME:-host}} $NUMBA_CACHE_DIR" >>{root}/calls\nexit "${{EXIT:-0}}"\n'
    )
    program.chmod(0o755)
    (tmp_path / "tmp").mkdir()

    def start(*words, **variables):
        (root / "calls").unlink(missing_ok=True)
        inherited = {key: text for key, text in os.environ.items() if not key.startswith("NUMBA_")}
        command = [root / "scripts/container", "start", "pdal-stages", *words]
        env = inherited | {"TMPDIR": str(tmp_path / "tmp")} | variables
        ended = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
        return ended, [line.split() for line in (root / "calls").read_text().splitlines()]

    return start


def test_without_a_volume_the_kernels_of_any_processor_are_there(image, tmp_path):
    ended, ((command, processor, folder),) = image("classify", "a.laz", EXIT="3")
    assert (ended.returncode, command) == (3, "classify") and processor != "host"
    assert Path(folder, "one/kernel.nbi").read_text() == "compiled"
    assert Path(folder).parent == tmp_path / "tmp" and Path(folder).stat().st_mode & 0o077 == 0
    _, ((_, _, again),) = image("classify", "a.laz")
    assert again == folder and len(os.listdir(tmp_path / "tmp")) == 1
