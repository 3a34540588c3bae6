"""Rounds of a tiled run: which stages run on the whole survey before others do, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from ..stages.base import Blocks, used_distances
from .planned_stage import PlannedStage

#: Meters; stages that look farther see saved results of the stages before them, which would
#: otherwise be computed again in a wide halo. The shipped model looks 81, bridges 367; in between
#: the value was not tuned. After a costly stage (:attr:`..stages.base.Stage.costly`) any does.
_FAR_M = 96.0


class RoundStage(NamedTuple):
    """A stage of a round, and how far around a tile it matters, in meters.

    A stage that looks 10 m far, after one that looks 5 m far, of which a later stage reads the
    results within 3 m of the tile, has `used_m` 3 and `before_m` 5: it is right there if points
    within 3 + 10 + 5 m are read.
    """

    used_m: float  #: later stages of the round use its results so far outside the tile
    before_m: float  #: the stages before it look so far beyond the points that it reads


@dataclass(frozen=True)
class Round:
    """Stages that run on all tiles, or larger squares, before later stages do."""

    begin: int  #: index of its first stage in :attr:`.plan.TilePlan.in_tiles`
    end: int  #: index after its last stage
    stages: list[RoundStage]
    halo_m: float  #: how far around each tile points are read
    #: Dimensions that are saved for the next round, which are those that the stages before `end`
    #: change. Where it is empty, they change none, or the next round runs them again.
    saved: list[str] = field(default_factory=list)
    #: Of the far-reaching stage at `end`: squares that are computed of all points.
    blocks: Blocks | None = None


def make_round(
    stages: list[PlannedStage],
    reaches: list[float],
    begin: int,
    end: int,
    saved: Sequence[str] = (),
    blocks: Blocks | None = None,
) -> Round:
    """Return a round of the stages from `begin` to `end`, which look `reaches` (meters) far."""
    part, reaches = stages[begin:end], reaches[begin:end]
    before = [0.0] * len(part)
    for n, stage in enumerate(part):
        seen = [k for k in range(n) if stage.sees_results_of(part[k])]
        before[n] = max((reaches[k] + before[k] for k in seen), default=0.0)
    used = used_distances(reaches, lambda m, n: part[m].sees_results_of(part[n]))
    halo = max((u + reach for u, reach in zip(used, reaches, strict=True)), default=0.0)
    distances = [RoundStage(*each) for each in zip(used, before, strict=True)]
    return Round(begin, end, distances, halo, list(saved), blocks)


def cut_into_rounds(stages: list[PlannedStage], reaches: list[float]) -> list[Round]:
    """Cut stages before those that look far, which then see saved results of the earlier ones.

    Blocks serve the first far-reaching stage, which then needs no halo.
    """
    rounds: list[Round] = []
    begin, open_ended = 0, False
    for at, stage in enumerate(stages):
        only = not open_ended and not any(each.blocks for each in rounds)
        blocks = stage.ours.blocks() if stage.ours is not None and only else None
        changed = _changed_by(stages[:at])
        seen = [each for each in stages[begin:at] if stage.sees_results_of(each)]
        least = 0.0 if any(each.ours and each.ours.costly for each in seen) else _FAR_M
        if blocks is not None or (changed is not None and seen and reaches[at] > least):
            rounds.append(make_round(stages, reaches, begin, at, changed or [], blocks))
            begin = begin if changed is None else at
        if blocks is not None:
            reaches = [*reaches[:at], 0.0, *reaches[at + 1 :]]
        open_ended = open_ended or (stage.ours is not None and stage.ours.open_ended)
    rounds.append(make_round(stages, reaches, begin, len(stages)))
    changed = _changed_by(stages)
    if changed and rounds[-1].halo_m > _FAR_M:  # on squares, of which tiles then take their points
        rounds[-1] = replace(rounds[-1], saved=changed)
        rounds.append(make_round(stages, reaches, len(stages), len(stages)))
    return rounds


def _changed_by(before: list[PlannedStage]) -> list[str] | None:
    """Return the dimensions that stages change; None where saving these is not enough."""
    if any(stage.ours is None and stage.type != "filters.merge" for stage in before):
        return None  # which may drop points
    return sorted({name for stage in before if stage.ours for name in stage.ours.creates()})
