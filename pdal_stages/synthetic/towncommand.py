"""The command ``pdal-stages-town``: a generated town under a simulated flight, with true classes, as LAS or LAZ."""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time

from ..base.asprs import class_name
from ..base.errors import OptionError, StageError
from .town import TownOptions
from .townfile import write_town


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``pdal-stages-town``; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="pdal-stages-town",
        description="Write a generated town under a simulated flight, with true classes, as LAS or LAZ.",
        epilog="Classes: 1 cars and furniture, 2 ground, 3/4/5 vegetation below 0.5 m, below 2 m, above; "
        "6 building, 9 water, 14 wire, 15 pole, 17 bridge.",
    )
    parser.add_argument("output", help="file to write, .las or .laz")
    for option in dataclasses.fields(TownOptions):
        many = {"nargs": 3, "type": float} if option.name == "origin" else {"type": type(option.default)}
        what = f"{option.metadata['what']} ({option.default})"
        parser.add_argument("--" + option.name.replace("_", "-"), help=what, **many)
    parser.add_argument("--points", type=float, help="about so many points: sets the size from the density")
    parser.add_argument("--threads", type=int, help="threads (all cores)")
    given = {name: value for name, value in vars(parser.parse_args(argv)).items() if value is not None}
    output, threads, points = given.pop("output"), given.pop("threads", None), given.pop("points", None)
    started = time.monotonic()
    try:
        options = TownOptions(**given)
        if points is not None:
            if "size" in given or not points > 0:
                raise OptionError("give '--size', or '--points' above 0, not both", where="pdal-stages-town")
            options = dataclasses.replace(options, size=math.sqrt(points / options.density))
        counts = write_town(options, output, threads=threads)
    except StageError as error:
        print(f"pdal-stages-town: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("pdal-stages-town: stopped", file=sys.stderr)
        return 130
    total = sum(counts.values())
    for code, count in counts.items():
        print(f"{code:>4}  {class_name(code):<26}{count:>13,}  {100 * count / total:5.1f} %")
    density = f"{total / options.size**2:.2f} per square meter"
    print(f"{output}: {total:,} points, {density}, {time.monotonic() - started:.1f} s")
    return 0
