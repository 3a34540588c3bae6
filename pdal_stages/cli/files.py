"""Files in, files out: classes, objects, what to review, and what was corrected."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..base.errors import StageError
from ..base.las import class_name
from ..base.messages import one_line, print_messages
from . import INPUTS, Parser, switch, takes_options, tiles

if TYPE_CHECKING:
    from ..tiling.classify import ClassifyTask
    from ..tiling.report import Job


def add_commands(parser: Parser) -> None:
    """``classify``, ``objects``, ``review`` and ``corrections``."""
    takes = parser.command("classify", _classify, "Classify clouds with a model", overrides=True, logged=True)
    takes("inputs", nargs="+", metavar="input", help=INPUTS)
    takes("output", help="A file; of several inputs a folder, or a name with # where the input's goes")
    takes("--model", default="standard", help="A model file, or one of pdal-stages models; default standard")
    takes(
        "--dimensions",
        metavar="LIST",
        help="Extra dimensions to write beside the input's own: e.g. Reliability,Margin,Probability_6, all, or none; "
        "default HeightAboveGround,Reliability, rounded to 1/32 (3 cm) and 1/64 (1.6 %%), which keeps files small",
    )
    switch(takes, "--noise", True, "Mark low and high noise first (filters.detachednoise)")
    takes(
        "--polygons",
        action="append",
        default=[],
        metavar="FILE=CODE",
        help="Class of ground inside the polygons of an OGR file, e.g. lakes.gpkg=9; of other classes too: "
        "bridges.gpkg=17:2,6; may be repeated (filters.polygons)",
    )
    takes(
        "--objects", metavar="FILE", help="Then write objects of all outputs to a vector file (see objects)"
    )
    switch(takes, "--bridges", True, "Find bridge decks (17), with heights of filters.hag_morphological")
    switch(takes, "--wires", False, "Find wires (14); tiles take 85 m more around them")
    switch(takes, "--towers", False, "Find wires, and towers and poles (15) with them; tiles take 145 m more")
    switch(takes, "--consistency", True, "Mend classes that contradict their surroundings, at the end")
    takes_options(takes, "filters.modelclassifier", "vegetation_heights", "keep_sure")
    takes("--where", help="Classify only the points for which this holds; the others serve as neighbors")
    takes("--metadata", metavar="FILE", help="Write the metadata of the run to a JSON file")
    tiles.add_arguments(parser.commands["classify"], survey=True)

    what = "Write buildings, trees, spans and decks of classified files to a vector file"
    takes = parser.command("objects", _objects, what, overrides=True, logged=True)
    takes("inputs", nargs="+", metavar="input", help="Classified files PDAL can read, folders, patterns")
    takes("output", help="Vector file to write: .gpkg, .geojson, .fgb or .shp")
    takes_options(takes, "writers.objects", "outlines", "cell")
    takes("--workers", type=int, default=1, metavar="N", help="Files read at the same time (1)")
    takes("--metadata", metavar="FILE", help="Write counts, verdicts and settings to a JSON file")

    what = "List where a person should look in classified files, worst first"
    takes = parser.command("review", _review, what, logged=True)
    takes("inputs", nargs="+", metavar="input", help="Classified files PDAL can read, folders, patterns")
    takes("output", help="Vector file to write: .gpkg, .geojson, .fgb or .shp")
    takes("--html", metavar="FILE", help="A page; default: beside the vector file, under its name")
    takes("--json", metavar="FILE", help="Write figures to a JSON file")
    takes("--share", type=float, default=0.95, metavar="SHARE", help="Expected errors that are listed (0.95)")
    takes("--cell", type=float, default=0.0, metavar="METERS", help="Side of the cells (by the density)")
    takes("--workers", type=int, default=1, metavar="N", help="Files read at the same time (1)")
    takes("--model", default="standard", help="What says how reliable classes are, where files do not")

    what = "Mark what a person has corrected, or looked at and found right, for train"
    takes = parser.command("corrections", _corrections, what)
    takes("before", help="The file as it was classified (LAS or LAZ)")
    takes("after", nargs="?", help="The same points, in any order, as the person left them")
    takes("--out", required=True, metavar="FILE", help="The points with the new classes, and Checked")
    area = "Polygons in which all was looked at (of review: where 'done' is 1); may be repeated"
    takes("--area", action="append", default=[], metavar="FILE", help=area)
    takes("--around", type=float, default=1.0, metavar="METERS", help="Around changes all was looked at (1)")


def _classify(options: argparse.Namespace) -> int:
    from ..pipeline.classify_request import WRITTEN, ClassifyRequest
    from ..tiling.classify import ClassifyTask

    own, others = [], list(options.overrides)
    if options.objects:
        from ..tiling.objects import OPTIONS_OF, refuse_tiles, write_objects, writer

        own = [one for one in others if not one.by_tag and one.selector in OPTIONS_OF]
        others = [one for one in others if one not in own]
    listed = options.dimensions
    named = WRITTEN if listed is None else tuple(name.strip() for name in listed.split(",") if name.strip())
    same = ("noise", "bridges", "towers", "consistency", "keep_sure")
    request = ClassifyRequest(
        options.model,
        tuple(others),
        options.where,
        named,
        wires=options.wires or options.towers,
        polygons=tuple(options.polygons),
        vegetation_heights=options.vegetation_heights or "",
        **{name: getattr(options, name) for name in same},
    )
    print_messages(*request.cost)
    task = ClassifyTask(
        tuple(options.inputs),
        options.output,
        request,
        tiles.options_of(options),
        metadata=options.metadata or "",
        log=options.log or "",
        reports=bool(options.report),
    )
    tiles.check_reports(options)
    then = None
    if options.objects:
        stage = writer(options.objects, own)
        refuse_tiles(task, options.objects)
        then = partial(write_objects, task.outputs, stage, max(1, task.options.local_workers))
    names = {code: one_line(name) for code, name in request.loaded.classes}
    if not task.in_one_piece:
        return _classify_tiles(task, options, names, then)
    if options.dry_run:
        request.pipeline(task.files[0], task.outputs[0])
        print("1 input, in one piece")
        return 0
    tiles.end_at_once(options)
    written = task.run_whole()
    print_messages(*written.messages)
    print(f"{tiles.counted(written.points, 'point')} written to {written.path}")
    tiles.print_classes(written.classes, written.left_alone, names)
    if then is not None:
        then()
    return 0


def _classify_tiles(
    task: ClassifyTask,
    options: argparse.Namespace,
    names: Mapping[int, str],
    then: Callable[[], dict[str, Any]] | None,
) -> int:
    def finished(job: Job) -> None:  # out.laz: 500 points; 2 ground 61.3 %, 6 building 12.0 %
        assert job.outputs is not None
        classes = {int(code): n for code, n in job.record.get("classes", {}).items()}
        total = sum(classes.values())
        shares = [
            f"{code} {names.get(code, class_name(code))} {100.0 * n / total:.1f} %"
            for code, n in sorted(classes.items())
        ]
        said = f"; {', '.join(shares)}" if shares else ""
        print(f"{job.outputs[0]}: {tiles.counted(job.record.get('written', 0), 'point')}{said}", flush=True)

    run, interrupted = tiles.ran(lambda: task.run_tiles(dry_run=options.dry_run, finished=finished))
    if options.dry_run:
        tiles.print_dry(run)
    else:
        tiles.print_run(run)
        tiles.print_classes(run.summary["classes"], run.summary["left_alone"], names)
        if then is not None and not interrupted and not run.failures:
            try:
                run.objects = then()
            except StageError:
                tiles.end_run(options, run, "")
                raise
    words = [word for word in options.arguments if word != "--resume"]
    same = shlex.join(["pdal-stages", *words]) if len(words) <= 20 else "the same command with"
    return tiles.end_run(options, run, f"{same} --resume" if interrupted else "")


def _objects(options: argparse.Namespace) -> None:
    from ..tiling.objects import write_objects, writer

    given = {name: value for name in ("outlines", "cell") if (value := getattr(options, name)) is not None}
    stage = writer(options.output, options.overrides, **given)
    write_objects(options.inputs, stage, options.workers, options.metadata)


def _review(options: argparse.Namespace) -> None:
    from ..pipeline.reviewing import lines, write_review

    html = str(Path(options.output).with_suffix(".html")) if options.html is None else options.html
    how = {name: getattr(options, name) for name in ("share", "cell", "model", "workers")}
    found = write_review(options.inputs, options.output, html, options.json or "", **how)
    print("\n".join(lines(found.to_dict())))
    print(f"written to {', '.join(name for name in (options.output, html, options.json) if name)}")


def _corrections(options: argparse.Namespace) -> None:
    from ..pipeline.correcting import write_corrections

    told = write_corrections(options.before, options.out, options.after or "", options.area, options.around)
    print("\n".join(told))
    print(f"written to {options.out}; next: pdal-stages train --base MODEL {options.out} --model NEW")
