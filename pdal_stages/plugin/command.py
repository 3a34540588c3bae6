"""``pdal-stages plugin``: make our stages PDAL's own, look whether they are, undo it."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to do, and where."""
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--install", action="store_true", help="Compile it and put it beside filters.python")
    what.add_argument("--check", action="store_true", help="Tell what is there and what is missing")
    what.add_argument("--uninstall", action="store_true", help="Take it away")
    parser.add_argument(
        "--folder",
        type=Path,
        metavar="DIR",
        help="Another folder, made where it is not there, which must then be in PDAL_DRIVER_PATH, together with that of "
        "filters.python",
    )


def run(options: argparse.Namespace) -> int:
    """Do it; 1 where something is missing."""
    from . import building

    if options.check:
        good, bad = building.check(options.folder)
        print("\n".join([*good, *(f"missing: {line}" for line in bad)]))
        return int(bool(bad))
    if options.uninstall:
        gone = building.uninstall(options.folder)
        print("\n".join(f"removed {path}" for path in gone) or "there is no plugin of ours")
        return 0
    files = building.install(options.folder)
    print(f"{len(files)} stages in {files[0].parent}; see them with: pdal --drivers")
    return 0
