"""A cell of the matrix: one thing that users do wrong or data that are odd, and what they see.

Every cell runs through the command line, in this process or in one of its own, and ends in a clear error or in a result.
An error is: exit code 1 (2 for wrong usage), one message on standard error that begins with the program's name, no
traceback, no file under the final name and none left beside it.

``docs/robustness.md`` lists the cells. It is written by

    PDAL_STAGES_ROBUSTNESS=docs/robustness.md python -m pytest tests/robustness -q

and without that variable every cell checks that it is listed there. A run of some of the tests replaces their rows; a
run of all of them writes the page anew.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "docs" / "robustness.md"
WRITE_TO = os.environ.get("PDAL_STAGES_ROBUSTNESS", "")
GROUPS = ("Options", "Pipeline JSON", "Clouds", "LAS files", "Models", "Outputs", "Environment")

#: (group, case, "error" or "result", what a user sees)
SEEN: list[tuple[str, str, str, str]] = []


@dataclass
class Done:
    """A finished command."""

    code: int
    out: str
    err: str


@cache
def listed() -> set[str]:
    """Cases in the table of the docs."""
    if not TABLE.exists():
        return set()
    rows = re.findall(r"^\| ([^|]+) \| (?:error|result) \|", TABLE.read_text(encoding="utf-8"), re.MULTILINE)
    return set(rows)


@dataclass
class Cell:
    """One case: run commands with :meth:`refused` and :meth:`runs`, or give the outcome with :meth:`note`."""

    group: str
    case: str
    folder: Path
    capture: object = None
    before: set[Path] = field(default_factory=set)

    def __post_init__(self) -> None:
        assert self.group in GROUPS and "|" not in self.case
        assert WRITE_TO or self.case in listed(), (
            f"'{self.case}' is not in {TABLE.name}: write the table anew"
        )

    # ---- commands ------------------------------------------------------------------------------------------

    def command(self, *words: object) -> Done:
        """Run the command line in this process."""
        from pdal_stages.cli import main

        self.before = self.files()
        self.capture.readouterr()
        try:
            code = main([str(word) for word in words])
        except SystemExit as end:  # wrong usage, said by argparse
            code = int(end.code or 0)
        out, err = self.capture.readouterr()
        return Done(code, out, err)

    def process(self, *words: object, **options) -> Done:
        """Run it in a process of its own."""
        self.before = self.files()
        environment = {**os.environ, **options.pop("env", {})}
        command = options.pop("command", [sys.executable, "-m", "pdal_stages.cli"])
        done = subprocess.run(
            [*command, *map(str, words)],
            capture_output=True,
            env={k: v for k, v in environment.items() if v is not None},
            cwd=options.pop("cwd", self.folder),
            timeout=options.pop("timeout", 300),
            **options,
        )
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
        self.note("error", message.removeprefix("pdal-stages: "))
        return message

    def runs(self, words: Iterable[object] | Done, result: str) -> Done:
        """The command must succeed; `result` says what is right about it, which the test goes on to check."""
        done = words if isinstance(words, Done) else self.command(*words)
        assert done.code == 0, done.err
        assert "Traceback" not in done.out + done.err
        assert not list(self.folder.rglob(".pdal-stages-partial-*"))
        self.note("result", result)
        return done

    def note(self, kind: str, text: str) -> None:
        """Put the outcome in the table."""
        if not any(row[:2] == (self.group, self.case) for row in SEEN):  # a case may take several commands
            SEEN.append((self.group, self.case, kind, self._plain(text)))

    def _plain(self, text: str) -> str:
        """Without the paths of this machine, in one line."""
        text = text.replace(str(self.folder) + "/", "").replace(str(self.folder), "FOLDER")
        text = text.replace(str(ROOT) + "/", "").replace(sys.prefix, "ENV")
        text = re.sub(r"/tmp/(?:[\w./-]*?pytest-[\w./-]+|pdal-stages-open-\w+)/", "", text)
        text = re.sub(r"\s+", " ", text)
        text = text if len(text) <= 330 else text[:330].rsplit(" ", 1)[0] + " ..."
        return text.replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*").replace("_", "\\_")


def job(path: Path, *stages: object, name: str = "job.json") -> Path:
    """Write a pipeline, one stage a line."""
    target = path / name
    rows = ",\n".join("  " + json.dumps(stage) for stage in stages)
    target.write_text("[\n" + rows + "\n]\n", encoding="utf-8")
    return target


def _merged(path: Path) -> list[tuple[str, str, str, str]]:
    """Rows of the page as it is, and what was seen in a run of some of the tests."""
    seen = {row[:2]: row for row in SEEN}
    rows, group = [], ""
    for line in path.read_text(encoding="utf-8").splitlines():
        group = line.removeprefix("## ") if line.startswith("## ") else group
        found = re.fullmatch(r"\| (.*?) \| (error|result) \| (.*) \|", line)
        if found:
            rows.append(seen.pop((group, found.group(1)), (group, *found.groups())))
    return rows + list(seen.values())


def write_table(path: Path) -> None:
    """The page of the docs."""
    import platform

    from pdal_stages.pipeline import pdal as pdal_env

    rows_seen = SEEN if {row[0] for row in SEEN} == set(GROUPS) else _merged(path)
    kinds = [row[2] for row in rows_seen]
    version = ".".join(map(str, pdal_env.version()))
    lines = [
        "# What happens when something is wrong",
        "",
        "Every row is a test that runs through the command line (most through PDAL too): it ends in an error that says",
        "what is wrong, where, what was found and what to do, or in a right result. An error means: exit code 1, the message",
        "on standard error, no output file under its name and no half-written one beside it, no traceback unless `--debug`.",
        "",
        f"{len(rows_seen)} cases: {kinds.count('error')} end in an error, {kinds.count('result')} in a result. "
        f"Written by `PDAL_STAGES_ROBUSTNESS=docs/robustness.md python -m pytest tests/robustness` "
        f"with PDAL {version}, Python {platform.python_version()}.",
        "",
    ]
    for group in GROUPS:
        rows = [row for row in rows_seen if row[0] == group]
        if rows:
            lines += [
                f"## {group}",
                "",
                f"{len(rows)} cases.",
                "",
                "| case | ends in | what a user sees |",
                "|---|---|---|",
            ]
            lines += [f"| {case} | {kind} | {text} |" for _, case, kind, text in rows] + [""]
    lines += FUZZED
    path.write_text("\n".join(lines), encoding="utf-8")


FUZZED = [
    "## Writes that fail",
    "",
    "For every kind of output, writes of the system are made short, or fail for a full disk or with an I/O error, at the",
    "beginning, in the middle and at the end (`tests/robustness/faulty.c`). Kinds are listed from the code, so a place that",
    "writes and has no case fails a test. It found a raster, a glTF file and a generated town that were taken for whole.",
    "PDAL 2.9 goes on after a write that failed, so a disk that is full for a moment leaves a hole in a LAZ file whose header",
    "and table of chunks are right: chunks are therefore read back before the file gets its name. That takes 0.2 to 0.9",
    "microseconds a point in the formats up to 3, which are decoded for it, and 0.01 in those from 6 on, whose chunks say how",
    "long their parts are.",
    "",
    "## Fuzzing",
    "",
    "The two parsers of this package, of pipelines and of model files, are fuzzed with atheris",
    "(`python tests/fuzz/fuzz.py pipeline -max_total_time=1800`, and `model`). Inputs that once failed are kept in",
    "`tests/fuzz/cases` and run with the tests, beside a short run of random changes. Last long run, 30 minutes each, both on",
    "one busy core: 777,222 pipelines with one finding (a number beyond a double went on as `Infinity`; fixed), 243,974",
    "model files with none.",
    "",
    "What else comes from elsewhere is changed at random for as long as is asked",
    "(`PDAL_STAGES_FUZZ_SECONDS=600 python -m pytest tests/fuzz -k where`; atheris runs these too). Last run, 10 minutes each on",
    "a quarter of a busy core, the findings mended before:",
    "",
    "| changed | tried | found on the way |",
    "|---|---|---|",
    "| `where`, against PDAL's own evaluation | 48,379 | nothing of ours; PDAL 2.2 crashes on a minus before a name |",
    "| LAS and LAZ files | 19,732 | 551 bytes that took 17 GB: chunks of billions of points |",
    "| tile indexes | 24,965 | two that were no errors of ours, one that counted to four billion |",
    "| EPT descriptions | 35,608 | nothing |",
    "| notes of a tiled run | 10,938 | notes of one kind believed as another |",
    "| results of tiles | 74,158 | a zip of another version; a dimension lost by one changed bit |",
    "| models with a network | 892 | nothing |",
    "| COPC files, with PDAL 2.9 | 539 | before the octree was looked at: 7 crashes of PDAL in 58 files, points left out in 6 |",
    "",
    "Three of them once more for 21 minutes each after all that was mended, on PDAL 2.2: 2,000,677 conditions, 621,963 LAS "
    "and LAZ files and 937,697 results",
    "of tiles, with no finding.",
    "",
]
