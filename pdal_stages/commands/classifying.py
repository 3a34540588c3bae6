"""Classes for points, and objects of classified ones."""

from __future__ import annotations

import argparse

from ..base.plain import print_messages
from ..tiling.command import add_arguments
from ..tiling.objects import add_arguments as add_objects_arguments
from .adder import INPUTS, Adder


def add_commands(add: Adder) -> None:
    """``classify`` and ``objects``."""
    takes = add("classify", _classify, "Classify a cloud with a model file", overrides=True)
    takes("inputs", nargs="+", metavar="input", help=INPUTS)
    takes(
        "output",
        help="A file; of several inputs a folder, which is made, or a name with # where the input's goes. Other dimensions "
        "and the header are kept",
    )
    takes(
        "--model",
        default="standard",
        help="A model file, or a shipped model's name (pdal-stages models); default standard",
    )
    takes(
        "--dimensions",
        metavar="LIST",
        help="Extra dimensions to write beside the input's own: e.g. Reliability,Margin,Probability_6, all, or none; "
        "default HeightAboveGround,Reliability, rounded to 1/32 (3 cm) and 1/64 (1.6 %%), which keeps files small",
    )
    takes(
        "--noise",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="Mark low and high noise first (filters.detachednoise)",
    )
    takes(
        "--polygons",
        action="append",
        default=[],
        metavar="FILE=CODE",
        help="Class of ground inside the polygons of an OGR file, e.g. lakes.gpkg=9; of other classes too: "
        "bridges.gpkg=17:2,6; may be repeated (filters.polygons)",
    )
    takes(
        "--objects",
        metavar="FILE",
        help="Then write buildings, trees, spans and decks of all outputs to this vector file (.gpkg, ...), as "
        "pdal-stages objects does; its options too: --writers.objects.tree_height=5",
    )
    takes(
        "--bridges",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="Find bridge decks (17), which leave ground and buildings (filters.bridges), with models whose heights "
        "filters.hag_morphological makes",
    )
    takes(
        "--wires",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="Find wires (14), whatever they were called (filters.wires); tiles are read with 85 m more around them",
    )
    takes(
        "--towers",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="Find wires, and towers and poles (15) where they meet; tiles are read with 145 m more around them",
    )
    takes(
        "--consistency",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="Mend classes that contradict their surroundings at the end (filters.consistency)",
    )
    takes(
        "--vegetation-heights",
        default="",
        metavar="LOW,MEDIUM",
        help="Vegetation below these heights in meters, e.g. 0.5,2, is low (3) and medium (4), the rest high (5)",
    )
    takes(
        "--keep-sure",
        type=float,
        metavar="SHARE",
        help="Leave points unclassified (1) where the model is not sure enough for this share of each class to be right, "
        "e.g. 0.98, as measured on ground it had not seen",
    )
    takes("--where", help="Classify only the points for which this holds; the others serve as neighbors")
    takes("--metadata", metavar="FILE", help="Write the metadata of the run to a JSON file")
    add_arguments(add.choices["classify"], survey=True)

    add(
        "objects",
        _objects,
        "Write buildings, trees, spans of wires and bridge decks of classified files to a vector file",
        overrides=True,
    )
    add_objects_arguments(add.choices["objects"])


def _classify(options: argparse.Namespace) -> int:
    from ..pipeline.classify_request import WRITTEN, ClassifyRequest
    from ..pipeline.inputs_outputs import overlooked
    from ..tiling.classify import ClassifyTask
    from ..tiling.command import classify, options_of

    own, others = [], list(options.overrides)
    if options.objects:
        from ..tiling.objects import OPTIONS_OF

        own = [one for one in others if not one.by_tag and one.selector in OPTIONS_OF]
        others = [one for one in others if one not in own]
    listed = options.dimensions
    named = WRITTEN if listed is None else tuple(name.strip() for name in listed.split(",") if name.strip())
    request = ClassifyRequest(
        options.model,
        tuple(others),
        options.where,
        named,
        noise=options.noise,
        bridges=options.bridges,
        wires=options.wires or options.towers,
        towers=options.towers,
        consistency=options.consistency,
        polygons=tuple(options.polygons),
        vegetation_heights=options.vegetation_heights,
        keep_sure=options.keep_sure,
    )
    print_messages(*request.cost, *overlooked(options.inputs, options.output))
    task = ClassifyTask(
        tuple(options.inputs),
        options.output,
        request,
        options_of(options),
        metadata=options.metadata or "",
        log=options.log or "",
    )
    if not options.objects:
        return classify(task, options)
    from ..tiling.objects import objects_of_outputs, refuse_tiles, writer

    stage = writer(options.objects, own)
    refuse_tiles(task, options.objects)
    return classify(task, options, lambda: objects_of_outputs(task, stage))


def _objects(options: argparse.Namespace) -> int:
    from ..tiling.objects import run_command

    return run_command(options)
