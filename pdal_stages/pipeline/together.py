"""Stages of ours that follow each other directly, run in one exchange of all points with PDAL.

Before each ``filters.python`` PDAL copies every dimension of every point for Python, and frees the copies after it. Stages
in one filter are handed the same arrays, with what those before them made.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from ..stages import registry
from .runtime import TRAMPOLINE


def joined(stages: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Lowered stages, those of ours that follow each other in one filter, which has the last one's tag.

    A stage that lets go of arrays while it works is the last in its filter.
    """
    wired = {name for stage in stages for name in _several(stage.get("inputs"))}
    out: list[dict[str, Any]] = []
    for stage in stages:
        before = out[-1] if out else {}
        joins = (
            _is_ours(before)
            and _is_ours(stage)
            and "inputs" not in stage
            and not {"user_data", "log"} & {*before, *stage}
            and str(before.get("tag")) not in wired
            and not registry.get(together(before["pdalargs"])[-1]["stage"]).lets_go
            and (kinds := _added(before, stage)) is not None
        )
        if not joins:
            out.append(stage)
            continue
        inputs = {"inputs": before["inputs"]} if "inputs" in before else {}
        members = [*together(before["pdalargs"]), stage["pdalargs"]]
        arguments = {"label": stage["pdalargs"]["label"], "stage": members[-1]["stage"], "together": members}
        out[-1] = {**stage, **inputs, "pdalargs": arguments}
        if kinds:
            out[-1]["add_dimension"] = [f"{name}={kind}" for name, kind in kinds.items()]
    return out


def together(arguments: dict[str, Any]) -> list[dict[str, Any]]:
    """The arguments of each stage in a filter of ours, in their order."""
    return arguments.get("together", [arguments])


def _is_ours(stage: dict[str, Any]) -> bool:
    return stage.get("type") == "filters.python" and stage.get("source") == TRAMPOLINE


def _added(*stages: dict[str, Any]) -> dict[str, str] | None:
    """Dimensions that some stages add, with their types; None where one is added as two types."""
    kinds: dict[str, str] = {}
    for text in (text for stage in stages for text in stage.get("add_dimension", [])):
        name, _, kind = text.partition("=")
        if kinds.setdefault(name, kind) != kind:
            return None
    return kinds


def _several(names: Any) -> Iterable[str]:
    return [] if names is None else [names] if isinstance(names, str) else map(str, names)
