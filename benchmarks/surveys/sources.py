"""Where each cloud comes from: `sources.csv` names repository, path, commit and SHA-256."""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Iterable
from pathlib import Path

SOURCES = {
    row["file"]: row
    for row in csv.DictReader(Path(__file__).with_suffix(".csv").read_text().splitlines())
}


def check(data: Path, files: Iterable[str]) -> None:
    """End the program, saying which, where a file is missing under the folder or is another one."""
    wrong = []
    for name in files:
        path, source = data / name, SOURCES[name]
        origin = (
            f"github.com/{source['repository']}, commit {source['commit'][:10]}, {source['path']}"
        )
        if not path.exists():
            wrong.append(f"{path} is missing: it is {origin}")
        elif (found := hashlib.sha256(path.read_bytes()).hexdigest()) != source["sha256"]:
            wrong.append(
                f"{path} is another file, sha256 {found[:10]}, not {source['sha256'][:10]}: take "
                f"{origin}"
            )
    if wrong:
        raise SystemExit(
            "\n".join([*wrong, f"{len(wrong)} files to be put right; nothing was trained"])
        )
