"""Pipelines behind the short commands: classify, train, accuracy."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..base.errors import DimensionError, ModelError, OptionError, StageError, suggest
from ..base.las import extra_dimensions
from ..base.outputs import check_outputs
from ..classifier.summary import FILE_NUMBER
from ..stages import preparation
from ..stages.accuracy import AccuracyStage
from ..stages.heights import preparation_of
from ..stages.points import Points
from . import pdal as pdal_env
from .filenames import LAS_WRITERS, stage_files
from .lowering import lower_stage
from .overrides import Override, apply_overrides
from .run import Pipeline
from .runtime import python_filter, wkt_of

#: Dimensions that `classify` writes beside the input's own.
WRITTEN = ("HeightAboveGround", "Reliability")
#: PDAL calls this for the points of one reader after the other.
_NUMBER = f"""\
import numpy as np
number = 0
def stage(ins, outs):
    global number
    number += 1
    outs["{FILE_NUMBER}"] = np.full(len(ins["X"]), number, np.uint32)
    return True
"""


def classify_job(
    source: str,
    target: str,
    model: str,
    overrides: Sequence[Override] = (),
    *,
    where: str | None = None,
    dimensions: Sequence[str] = WRITTEN,
) -> Pipeline:
    """Read, give heights if the model wants them, classify, write with everything else kept.

    `dimensions` says which of those made on the way are written beside the input's own, or ``all``.
    """
    from ..stages.loading import loaded_model

    classifier: dict[str, Any] = {
        "type": "filters.modelclassifier",
        "model": model,
        **({"where": where} if where else {}),
    }
    for option, name in (("margin", "Margin"), ("variance", "Variance"), ("probabilities", "Probability_")):
        if any(one.startswith(name) for one in dimensions):
            classifier[option] = True
    loaded = loaded_model(_overridden(classifier, overrides)["model"])
    if by_hand := loaded.info.get("by_hand"):
        raise ModelError(
            "what the model reads was made by stages that a model file does not carry",
            where=model,
            found=", ".join(by_hand),
            cure="Write a pipeline: the reader, these stages with their options of training, filters.modelclassifier, and "
            "the writer",
        )
    prepared = loaded.info.get("preparation") or preparation_of(loaded.required_dimensions)
    pipeline = Pipeline([_reader(source, "input"), *prepared, classifier, _writer(target)], overrides)
    of_pdal = any(stage["type"] in preparation.OF_PDAL for stage in prepared)
    made = {"HeightAboveGround": "double"} if of_pdal else {}
    for ours in pipeline.lowered.ours:
        made |= ours.stage.creates()
    keep = _extra_dims(source, made, dimensions)
    writer = pipeline.lowered.stages[-1]
    if keep and writer.get("type") in LAS_WRITERS:
        writer.setdefault("extra_dims", keep)
    return pipeline


def _extra_dims(source: str, made: dict[str, str], wanted: Sequence[str]) -> str:
    """The option of the writer: the input's own extra dimensions, and those wanted of what the stages make."""
    names = [name for name in made if name != "Classification"]
    for name in wanted:
        if name not in ("all", "none", *names) and list(wanted) != list(WRITTEN):
            raise OptionError(
                "--dimensions names a dimension no stage creates",
                found=name,
                cure=f"{suggest(name, names)}There are {', '.join(names)}; or all, or none",
            )
    chosen = names if "all" in wanted else [name for name in names if name in wanted]
    is_las = Path(source).suffix.lower() in (".las", ".laz")
    own = extra_dimensions(source) if is_las else {}
    if "all" in wanted or not is_las or not all(re.fullmatch(r"[A-Za-z_]\w*", name) for name in own):
        return "all"  # what other formats hold is not known here
    return ",".join(f"{name}={kind}" for name, kind in {**own, **{n: made[n] for n in chosen}}.items())


def outputs_of(sources: Sequence[str], target: str) -> list[str]:
    """An output for each input: in a folder under the input's name, or with the input's name for ``#``.

    A name without a suffix is that of a folder where there are several inputs, one that ends with a slash in any case.

    Raises
    ------
    StageError
        Where several inputs would be written to one file.
    """
    path = Path(target)
    if _is_folder(target, sources):
        outputs = [str(path / Path(source).name) for source in sources]
    elif "#" in path.name:
        outputs = [str(path.with_name(path.name.replace("#", Path(source).stem))) for source in sources]
    elif len(sources) > 1:
        raise StageError(
            "several inputs would be written to one file",
            found=f"{len(sources)} inputs, {target}",
            cure="Name a folder (with a slash at its end), or put '#' where the input's name should be, e.g. "
            "classified_#.laz. To merge them into one file, use a pipeline",
        )
    else:
        return [target]
    first: dict[str, str] = {}
    for source, output in zip(sources, outputs, strict=True):
        other = first.setdefault(output, source)
        if other is not source:
            same = os.path.realpath(other) == os.path.realpath(source)
            raise StageError(
                "an input is given twice"
                if same
                else "two inputs have one name and would be written to one file",
                found=f"{source}: {output}" if same else f"{other} and {source}: {output}",
                cure="Give it once" if same else "Classify them into different folders, or rename one",
            )
    return outputs


def make_folder(target: str, outputs: Sequence[str]) -> None:
    """Make the folder that `outputs_of` found in a name, where it is not there."""
    folder = Path(target)
    if outputs and Path(outputs[0]) != folder and Path(outputs[0]).parent == folder:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StageError("the output's folder cannot be made", where=target, found=error) from None


def _is_folder(target: str, sources: Sequence[str]) -> bool:
    path = Path(target)
    return (
        path.is_dir()
        or target.endswith(("/", os.sep))
        or (len(sources) > 1 and not path.suffix and "#" not in path.name and not path.exists())
    )


def train_pipeline(
    sources: Iterable[str], model: str, overrides: Iterable[Override] = (), **options: Any
) -> list[dict[str, Any]]:
    """Read labelled files, give heights if wanted, train, write the model; of several files the score is by file."""
    from ..stages.classifiermodel import ClassifierModel

    writer = {"type": "writers.classifiermodel", "filename": model, **options}
    stage = cast(ClassifierModel, lower_stage(_overridden(writer, overrides)).stage)
    heights = preparation_of(stage.wished)
    readers = [_reader(name, f"input{i}") for i, name in enumerate(sources, 1)]
    if len(readers) == 1 or stage.groups or stage.survey or stage.algorithm != "random_forest":
        return [*readers, *heights, writer]
    number = python_filter("pdal_stages_file_number", _NUMBER, {}, {FILE_NUMBER: "uint32_t"})
    return [*readers, number, *heights, {**writer, "groups": FILE_NUMBER}]


def _overridden(stage: dict[str, Any], overrides: Iterable[Override]) -> dict[str, Any]:
    """A stage with the overrides of its type."""
    of_type = [o for o in overrides if not o.by_tag and o.selector == stage["type"]]
    return apply_overrides([stage], of_type)[0]


def accuracy_pipeline(
    sources: Sequence[str], dimension: str, reference: str, **outputs: str
) -> list[dict[str, Any]]:
    """Read files, folders or patterns, compare two dimensions."""
    files = las_files(sources)
    tags = ["input"] if len(files) == 1 else [f"input{i}" for i in range(1, len(files) + 1)]
    return [
        *map(_reader, files, tags),
        {"type": "filters.accuracy", "dimension": dimension, "reference": reference, **outputs},
    ]


def compare_files(
    sources: Sequence[str],
    references: Sequence[str],
    dimension: str,
    reference_dimension: str,
    overrides: Iterable[Override] = (),
    **outputs: str,
) -> None:
    """Compare files with others that hold the same points in the same order, in pairs of the same name.

    Both are files, folders or patterns; `outputs` are options of ``filters.accuracy``.

    Raises
    ------
    StageError
        If a file has no partner, or two do not hold the same points.
    """
    pairs = paired(las_files(sources), las_files(references))
    listed = {"files": [name for pair in pairs for name in pair]}
    wanted: dict[str, Any] = {"type": "filters.accuracy", **listed, **outputs}
    (given,) = apply_overrides([wanted], overrides)
    renamed = {"dimension": "Classification", "reference": "Reference"}
    stage = cast(AccuracyStage, lower_stage({**given, **renamed}).stage)
    check_outputs(stage.outputs(), [*listed["files"], *stage_files(stage)])
    parts, wkt = [], ""
    for source, reference in pairs:
        mine, wkt, withheld = _points_of(source, dimension)
        true, _, _ = _points_of(reference, reference_dimension)
        _refuse_other_points(mine, true, source, reference)
        named = [span.dimension for span in stage.ignore.spans] if stage.ignore else []
        kept = [n for n in ("X", "Y", "Z", "Reliability", "Margin", *named) if n in mine.dtype.names]
        part = {name: mine[name] for name in kept}
        codes = {"Classification": mine[dimension], "Reference": true[reference_dimension]}
        parts.append({"Withheld": withheld, **part, **codes})
    shared = [name for name in parts[0] if all(name in part for part in parts)]
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in shared}
    stage.run(stage.points(arrays, wkt=wkt))


def las_files(names: Sequence[str]) -> list[str]:
    """The files that names, folders and patterns stand for, sorted within each."""
    found: list[str] = []
    for name in names:
        if Path(name).is_dir():
            inside = sorted(str(p) for p in Path(name).iterdir() if p.suffix.lower() in (".las", ".laz"))
            if not inside:
                raise StageError("the folder holds no LAS or LAZ files", found=name)
            found += inside
        elif not Path(name).exists() and (matches := sorted(glob.glob(name))):
            found += matches
        else:
            found.append(name)
    return found


def paired(sources: Sequence[str], references: Sequence[str]) -> list[tuple[str, str]]:
    """Files with their references: of the same name, or the longest name inside theirs (c_town: town).

    Raises
    ------
    StageError
        If a file has no reference, or shares it with another.
    """
    if len(sources) == len(references) == 1:
        return [(sources[0], references[0])]
    by_name = {Path(name).stem: name for name in references}
    pairs: dict[str, str] = {}
    for source in sources:
        inside = [name for name in by_name if name in Path(source).stem]
        if not inside:
            raise StageError(
                "a file has no reference of its name",
                found=source,
                cure=f"Name the references like the files they belong to, not {', '.join(list(by_name)[:5])}",
            )
        reference = by_name[max(inside, key=len)]
        if reference in pairs:
            raise StageError(
                "two files have the same reference", found=f"{pairs[reference]} and {source}: {reference}"
            )
        pairs[reference] = source
    return [(source, reference) for reference, source in pairs.items()]


def _points_of(name: str, dimension: str) -> tuple[Any, str, NDArray]:
    """All points of a file with class codes freed of flag bits, its spatial reference, and the withheld flags."""
    pipeline = Pipeline([_reader(name, "input")])
    pipeline.execute()
    array: Any = np.concatenate(pipeline.arrays) if pipeline.arrays else np.empty(0)
    names = array.dtype.names or ()
    if dimension not in names:
        raise DimensionError(f"the dimension '{dimension}' is missing", where=name, found=", ".join(names))
    points = Points(
        {n: array[n] for n in names},
        legacy_flags=pdal_env.flags_inside_classification(names, pipeline.metadata),
    )
    withheld = np.array(points.flag("Withheld"), np.uint8)
    if "Classification" in names:
        array["Classification"] = points.class_codes
    readers = [v for k, v in pipeline.metadata.get("metadata", {}).items() if k.startswith("readers.")]
    node = readers[0] if readers else None
    return array, wkt_of(node[0] if isinstance(node, list) else node), withheld


def _refuse_other_points(mine: np.ndarray, true: np.ndarray, source: str, reference: str) -> None:
    if len(mine) != len(true):
        raise StageError(
            "the two files do not hold the same points",
            found=f"{len(mine):,} points in {source}, {len(true):,} in {reference}",
            cure="Compare files of the same points, or keep the labels with filters.ferry while classifying",
        )
    for axis in sorted({"X", "Y", "Z"} & set(mine.dtype.names or ()) & set(true.dtype.names or ())):
        apart = np.abs(mine[axis] - true[axis])
        if apart.size and apart.max() > 0.01:
            raise StageError(
                "the two files do not hold the same points in the same order",
                found=f"{int(np.count_nonzero(apart > 0.01)):,} points of {source} and {reference} differ in {axis}",
                cure="Keep the labels with filters.ferry while classifying instead",
            )


def _reader(source: str, tag: str) -> dict[str, Any]:
    """A reader; of LAS 1.0-1.3 it takes the extra dimensions too, which PDAL leaves out unless told."""
    stage: dict[str, Any] = {"filename": str(source), "tag": tag}
    if Path(source).suffix.lower() in (".las", ".laz") and not str(source).lower().endswith(".copc.laz"):
        stage.update({"type": "readers.las", "use_eb_vlr": True})
    return stage


def _writer(target: str) -> dict[str, Any]:
    """A writer that keeps the input's header, where it is a LAS file."""
    stage: dict[str, Any] = {"filename": target, "tag": "output"}
    if target.lower().endswith(".copc.laz") and pdal_env.writes_copc():
        stage.update({"type": "writers.copc", "forward": "all"})
    elif Path(target).suffix.lower() in (".las", ".laz"):
        stage.update({"type": "writers.las", "forward": "all"})
    return stage
