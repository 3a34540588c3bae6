"""The command ``pdal-stages-town``."""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time

from ..base.asprs import class_name
from ..base.errors import OptionError, StageError
from .las import write_town
from .town import TownOptions


def _parser() -> argparse.ArgumentParser:
    d = TownOptions()
    p = argparse.ArgumentParser(
        prog="pdal-stages-town",
        description="Write a generated town under a simulated flight, with true classes, as LAS or LAZ.",
        epilog="The same options give the same points. Classes: 1 cars and furniture, 2 ground, "
        "3/4/5 vegetation below 0.5 m, below 2 m, above; 6 building, 9 water, 14 wire, 15 pole and tower, "
        "17 bridge; with --outliers 7 and 18.",
    )
    p.add_argument("output", help="file to write, .las or .laz")
    p.add_argument("--size", type=float, default=None, help=f"side of the square, metres ({d.size:g})")
    p.add_argument("--density", type=float, default=d.density, help="returns per square metre (%(default)g)")
    p.add_argument(
        "--points", type=float, default=None, help="about so many points: sets the size from the density"
    )
    p.add_argument("--seed", type=int, default=d.seed, help="another number, another town (%(default)s)")
    p.add_argument("--altitude", type=float, default=d.altitude, help="flying height, metres (%(default)g)")
    p.add_argument(
        "--scan-angle", type=float, default=d.scan_angle, help="half opening, degrees (%(default)g)"
    )
    p.add_argument(
        "--overlap", type=float, default=d.overlap, help="share of a swath seen twice (%(default)g)"
    )
    p.add_argument("--noise", type=float, default=d.noise, help="range noise, metres (%(default)g)")
    p.add_argument(
        "--outliers", type=float, default=d.outliers, help="share of pulses with an outlier (%(default)g)"
    )
    p.add_argument(
        "--origin",
        type=float,
        nargs=3,
        default=d.origin,
        metavar=("X", "Y", "Z"),
        help="south-west corner and mean ground height",
    )
    p.add_argument("--srs", default=d.srs, help="EPSG:n or none (%(default)s)")
    p.add_argument("--minor-version", type=int, default=4, help="LAS 1.2, 1.3 or 1.4 (%(default)s)")
    p.add_argument("--dataformat-id", type=int, default=6, help="point format 0-3, 6-8 (%(default)s)")
    p.add_argument("--true-height", action="store_true", help="add the dimension TrueHeight")
    p.add_argument("--picture", help="also draw the town from above into this PNG (reads the file back)")
    p.add_argument("--threads", type=int, default=None, help="threads (all cores)")
    return p


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``pdal-stages-town``; returns the exit status."""
    args = _parser().parse_args(argv)
    try:
        size = args.size
        if args.points is not None:
            if size is not None:
                raise OptionError("give '--size' or '--points', not both", where="pdal-stages-town")
            if not (args.points > 0 and args.density > 0):
                raise OptionError(
                    "'--points' and '--density' must be above 0",
                    where="pdal-stages-town",
                    found=(args.points, args.density),
                )
            size = math.sqrt(args.points / args.density)
        values = {f.name: getattr(args, f.name) for f in dataclasses.fields(TownOptions) if f.name != "size"}
        values["origin"] = tuple(values["origin"])
        options = TownOptions(size=size if size is not None else TownOptions().size, **values)
        started = time.monotonic()
        counts = write_town(
            options,
            args.output,
            minor_version=args.minor_version,
            dataformat_id=args.dataformat_id,
            true_height=args.true_height,
            threads=args.threads,
        )
        if args.picture:
            _picture(args.output, args.picture)
    except StageError as error:
        print(f"pdal-stages-town: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("pdal-stages-town: stopped", file=sys.stderr)
        return 130
    total = sum(counts.values())
    for code, count in counts.items():
        print(f"{code:>4}  {class_name(code):<26}{count:>13,}  {100 * count / total:5.1f} %")
    print(
        f"{args.output}: {total:,} points, {total / options.size**2:.2f} per square metre, "
        f"{options.size:.0f} m square, {time.monotonic() - started:.1f} s"
    )
    return 0


def _picture(cloud: str, picture: str) -> None:
    import laspy

    from ..reports.panels import legend, present_classes
    from ..reports.pictures import write_png
    from ..reports.views import top_view

    las = laspy.read(cloud)
    import numpy as np

    codes = np.asarray(las.classification)
    view = top_view(las.x, las.y, las.z, codes, width=1200)
    write_png(picture, np.vstack([view, legend(present_classes(codes), view.shape[1])]))
