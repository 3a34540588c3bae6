"""A cell of the matrix: one thing that users do wrong or data that are odd, and what they see.

Every cell runs through the command line, in this process or in one of its own, and ends in a clear error or in a result.
An error is: exit code 1 (2 for wrong usage), one message on standard error that begins with the program's name, no
traceback, no file under the final name and none left beside it.

The pages of the docs list the tests and their cases (``docs/robustness_cases.py``).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import audit

ROOT = Path(__file__).resolve().parents[2]
GROUPS = ("Options", "Pipeline JSON", "Clouds", "LAS files", "Models", "Outputs", "Environment")


@dataclass
class Done:
    """A finished command."""

    code: int
    out: str
    err: str


@dataclass
class Cell:
    """One case: run commands with :meth:`refused` and :meth:`runs`."""

    group: str
    case: str
    folder: Path
    capture: object = None
    before: set[Path] = field(default_factory=set)

    def __post_init__(self) -> None:
        assert self.group in GROUPS

    # ---- commands ------------------------------------------------------------------------------------------

    def command(self, *words: object) -> Done:
        """Run the command line in this process."""
        from pdal_stages.cli import main

        self.before = self.files()
        self.capture.readouterr()
        watch = audit.Watch(words, Path.cwd(), self._log)
        usual = {name: os.environ.get(name) for name in ("PYTHONPATH", "PDAL_STAGES_AUDIT")}
        _set({name: watch.environment(dict(usual))[name] for name in usual})
        try:
            with watch:
                code = main([str(word) for word in words])
        except SystemExit as end:  # wrong usage, said by argparse
            code = int(end.code or 0)
        finally:
            _set(usual)
        out, err = self.capture.readouterr()
        assert not watch.beyond, watch.beyond
        return Done(code, out, err)

    @property
    def _log(self) -> Path:
        """What watched processes report; beside the folder, whose files are counted."""
        return self.folder.with_name(f"{self.folder.name}.audit")

    def process(self, *words: object, **options) -> Done:
        """Run it in a process of its own."""
        self.before = self.files()
        environment = {**os.environ, **options.pop("env", {})}
        command = options.pop("command", [sys.executable, "-m", "pdal_stages.cli"])
        folder = Path(options.pop("cwd", self.folder))
        watch = audit.Watch(words, folder, self._log)
        with watch:
            done = subprocess.run(
                [*command, *map(str, words)],
                capture_output=True,
                env={k: v for k, v in watch.environment(environment).items() if v is not None},
                cwd=folder,
                timeout=options.pop("timeout", 300),
                **options,
            )
        assert not watch.beyond, watch.beyond
        return Done(
            done.returncode, done.stdout.decode(errors="replace"), done.stderr.decode(errors="replace")
        )

    def files(self) -> set[Path]:
        return {path for path in self.folder.rglob("*") if path.is_file()}

    # ---- outcomes ------------------------------------------------------------------------------------------

    def refused(self, words: Iterable[object] | Done, *says: str, code: int = 1) -> str:
        """The command must end in a clear error that holds each of the texts; the message."""
        done = words if isinstance(words, Done) else self.command(*words)
        everything = done.out + done.err
        assert done.code == code, (done.code, everything)
        assert "Traceback" not in everything, everything
        assert "pdal-stages: " in done.err, done.err
        message = done.err[done.err.rindex("pdal-stages: ") :].strip()  # PDAL may have begun the line
        for text in says:
            assert text in message, (text, message)
        left = self.files() - self.before
        assert not left, f"left behind: {left}"
        return message

    def runs(self, words: Iterable[object] | Done, result: str) -> Done:
        """The command must succeed; `result` says what is right about it, which the test goes on to check."""
        done = words if isinstance(words, Done) else self.command(*words)
        assert done.code == 0, done.err
        assert "Traceback" not in done.out + done.err
        assert not list(self.folder.rglob(".pdal-stages-partial-*"))
        return done


def _set(variables: dict[str, str | None]) -> None:
    for name, value in variables.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def job(path: Path, *stages: object, name: str = "job.json") -> Path:
    """Write a pipeline, one stage a line."""
    target = path / name
    rows = ",\n".join("  " + json.dumps(stage) for stage in stages)
    target.write_text("[\n" + rows + "\n]\n", encoding="utf-8")
    return target
