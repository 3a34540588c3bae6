"""Commands as users type them, and the two ways in which they may end: a clear error, or a result.

An error is: exit code 1 (2 for wrong usage), one message on standard error that begins with the
program's name, no traceback, no file under the final name and none left beside it.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from block_scene import ground_and_block

HAG = {"type": "filters.hag_minima"}


@dataclass
class Done:
    """A finished command."""

    code: int
    out: str
    err: str


class Command:
    """Runs commands in a folder, with :meth:`refused` and :meth:`runs` for how they must end."""

    def __init__(self, folder: Path, capture) -> None:
        self.folder, self.capture = folder, capture
        self.before: set[Path] = set()

    def __call__(self, *words: object) -> Done:
        """In this process."""
        from pdal_stages.cli import main

        self.before = self.files()
        self.capture.readouterr()
        try:
            code = main([str(word) for word in words])
        except SystemExit as end:  # wrong usage, said by argparse
            code = int(end.code or 0)
        return Done(code, *self.capture.readouterr())

    def process(
        self, *words: object, command: list[str] | None = None, env: dict | None = None, **more
    ) -> Done:
        """In a process of its own."""
        self.before = self.files()
        done = subprocess.run(
            [*(command or [sys.executable, "-m", "pdal_stages.cli"]), *map(str, words)],
            capture_output=True,
            env={
                name: value
                for name, value in {**os.environ, **(env or {})}.items()
                if value is not None
            },
            timeout=300,
            **{"cwd": self.folder, **more},
        )
        out, err = (text.decode(errors="replace") for text in (done.stdout, done.stderr))
        return Done(done.returncode, out, err)

    def files(self) -> set[Path]:
        return {path for path in self.folder.rglob("*") if path.is_file()}

    def refused(self, words: Iterable[object] | Done, *says: str) -> str:
        """The command must end in a clear error that holds each of the texts; the message."""
        done = words if isinstance(words, Done) else self(*words)
        everything = done.out + done.err
        assert done.code in (1, 2), (done.code, everything)
        assert "Traceback" not in everything, everything
        message = done.err[
            done.err.rindex("pdal-stages: " if done.code == 1 else "usage:") :
        ].strip()
        for text in says:
            assert text in message, (text, message)
        assert not self.files() - self.before, "left behind"
        return message

    def runs(self, words: Iterable[object] | Done) -> Done:
        """The command must succeed."""
        done = words if isinstance(words, Done) else self(*words)
        assert done.code == 0, done.err
        assert "Traceback" not in done.out + done.err
        assert not list(self.folder.rglob(".pdal-stages-partial-*"))
        return done


def job(folder: Path, *stages: object, name: str = "job.json") -> Path:
    """Write a pipeline, one stage a line."""
    rows = ",\n".join(
        "  " + json.dumps(str(stage) if isinstance(stage, Path) else stage) for stage in stages
    )
    (folder / name).write_text("[\n" + rows + "\n]\n", encoding="utf-8")
    return folder / name


def las(path: Path, **more: object) -> dict[str, object]:
    """A writer that keeps what the input had, and all dimensions."""
    return {
        "type": "writers.las",
        "filename": str(path),
        "extra_dims": "all",
        "forward": "all",
        **more,
    }


def scene(n: int = 600, seed: int = 1) -> dict[str, np.ndarray]:
    """Ground with a block on it, in coordinates of a national grid."""
    return ground_and_block(n, seed, at=(500_000, 5_400_000, 100))


def repack(path: Path, target: Path, edit: Callable[[dict, dict], object]) -> Path:
    """A copy of a model file with manifest and members edited, checksums put right."""
    with zipfile.ZipFile(path) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    head = json.loads(members.pop("manifest.json"))
    edit(head, members)
    for entry in head.get("arrays", {}).values() if isinstance(head.get("arrays"), dict) else ():
        if entry.get("file") in members:
            entry["sha256"] = hashlib.sha256(members[entry["file"]]).hexdigest()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("manifest.json", json.dumps(head))
        for name, data in members.items():
            archive.writestr(name, data)
    return target
