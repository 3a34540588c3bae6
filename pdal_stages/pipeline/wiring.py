"""Which stages PDAL runs: those that lead to the first end of a pipeline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..base.errors import PipelineError

_CURE = (
    "Write one file after the other (a writer hands on what it gets, so leave its 'inputs' out), or put a last stage there "
    'that has all ends as inputs, e.g. {"type": "filters.merge", "inputs": [...]}'
)


def inputs_of(stages: Sequence[dict[str, Any]]) -> list[list[int]] | None:
    """The stages that each takes points from, as PDAL wires them; None where a tag is not known, which PDAL tells."""
    tagged: dict[str, int] = {}
    waiting: list[int] = []
    wired: list[list[int]] = []
    for number, stage in enumerate(stages):
        named = stage.get("inputs") or []
        try:
            chosen = [tagged[str(tag)] for tag in ([named] if isinstance(named, str) else named)]
        except KeyError:
            return None
        waiting = chosen or waiting
        if is_reader(stages, number):
            wired.append([])
            waiting = [*waiting, number]
        else:
            wired.append(waiting)
            waiting = [number]
        if "tag" in stage:
            tagged[str(stage["tag"])] = number
    return wired


def is_reader(stages: Sequence[dict[str, Any]], number: int) -> bool:
    """Whether a stage is a reader: without a type, one that is not the last of several."""
    kind = stages[number].get("type", "")
    return kind.startswith("readers.") or (not kind and (number == 0 or number < len(stages) - 1))


def run_by_pdal(stages: Sequence[dict[str, Any]]) -> list[int]:
    """The numbers of the stages that PDAL runs."""
    wired = inputs_of(stages)
    if wired is None:
        return list(range(len(stages)))
    taken = {one for inputs in wired for one in inputs}
    waiting = [next(number for number in range(len(stages)) if number not in taken)]
    found: set[int] = set()
    while waiting:
        number = waiting.pop()
        found.add(number)
        waiting += [one for one in wired[number] if one not in found]
    return sorted(found)


def warning_of_ends(stages: Sequence[dict[str, Any]], run: Sequence[int], where: Sequence[str]) -> str:
    """The warning of stages that PDAL leaves out; `where` each stands.

    Raises
    ------
    PipelineError
        If a pipeline that has writers would run none.
    """
    left = [number for number in range(len(stages)) if number not in run]
    named = ", ".join(f"{_name(stages[number])} ({where[number]})" for number in left[:5])
    what = "a pipeline with several ends: PDAL runs only what leads to the first of them"
    writing = [n for n in range(len(stages)) if str(stages[n].get("type", "")).startswith("writers.")]
    if writing and not set(writing) & set(run):
        raise PipelineError(what, where=where[run[-1]], found=f"not run: {named}", cure=_CURE)
    return f"{what}. Not run: {named}. {_CURE}"


def check_start(stages: Sequence[dict[str, Any]], ours: Mapping[int, str]) -> None:
    """Refuse a pipeline that begins with a filter or writer, which newer PDAL refuses and older one runs on nothing.

    `ours`: types of the stages that are ours, by their place.
    """
    if stages and not is_reader(stages, 0):
        raise PipelineError(
            "the pipeline does not start with a reader",
            found=ours.get(0, stages[0].get("type", "")),
            cure="Put the file that is to be read first",
        )


def _name(stage: dict[str, Any]) -> str:
    kind, name = stage.get("type", ""), str(stage.get("filename", ""))
    return " ".join(filter(None, [kind, name])) if kind.startswith("writers.") or not kind else str(kind)
