"""The jobs of the rounds before the last: squares of tiles, and blocks of a far-reaching stage."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cached_property, partial

from ..base.hashing import fingerprint
from ..base.version import build
from ..pipeline.workers import Task
from .earlier_rounds import block_name, blocks_near, make_block, square_name
from .jobs import BlockJob, TileJob
from .options import Box, TileGrid
from .plan_run import PlanRun
from .survey_run import stop_if_hopeless


class RoundJobs:
    """The rounds before the last of a run."""

    def __init__(self, run: PlanRun) -> None:
        self.run = run

    def make(self) -> None:
        """Run the rounds that waiting tiles need and an earlier run has not left.

        Jobs that depend on failed ones fail, too.
        """
        waiting = [job for job in self.run.tiles if job.state == "waiting"]
        users = waiting
        layers: list[tuple[list[TileJob], list[BlockJob]]] = []
        for number in reversed(range(len(self.run.plan.rounds) - 1)):
            layers.insert(0, self._layer(number, users))
            users = layers[0][0]
        for number, (squares, blocks) in enumerate(layers):
            for job in squares:
                job.fail_with_needed()
            label = f"round {number + 1}"
            task_of = partial(self.run.tile_task, number)
            for _ in self.run.do(label, self.run.unkept(squares), task_of):
                pass
            for block in blocks:
                block.fail_with_needed()
            for _ in self.run.do(f"{label}, blocks", self.run.unkept(blocks), self._block_task):
                pass
            every = [*squares, *self._unneeded_squares(number, squares)]
            self.run.squares.append(sorted(every, key=lambda job: job.tile))
        for job in waiting:
            job.fail_with_needed()
        stop_if_hopeless([job.reason for job in waiting])

    def _unneeded_squares(self, number: int, needed: Sequence[TileJob]) -> list[TileJob]:
        """Return the jobs of a round of which nothing is needed any more, with saved records.

        Their arrays may be gone, but their points count in the report of the whole survey.
        """
        others = self._points_of_squares.keys() - {job.tile for job in needed}
        jobs = [self._square_job(number, square) for square in sorted(others)]
        for job in jobs:
            job.keep(self.run.store.record(job.name, job.digest) or {})
        return jobs

    @cached_property
    def squares_without_record(self) -> list[list[tuple[int, int]]]:
        """Return the squares of each round before the last that lack a record which reports need.

        Reports need those of squares whose tiles have a record or will have one: tiles that are
        kept without a record are in no report.
        """
        reported = {
            self.run.square_of(job)
            for job in self.run.tiles
            if job.state == "waiting" or job.record is not None
        }
        without = []
        for number in range(len(self.run.plan.rounds) - 1):
            jobs = [self._square_job(number, square) for square in sorted(reported)]
            without.append([j.tile for j in jobs if not self.run.store.record(j.name, j.digest)])
        return without

    @cached_property
    def _points_of_squares(self) -> dict[tuple[int, int], int]:
        """Return the squares that have points, and how many."""
        points: Counter[tuple[int, int]] = Counter()
        for job in self.run.tiles:
            points[self.run.square_of(job)] += job.points
        return points

    def _layer(self, number: int, users: list[TileJob]) -> tuple[list[TileJob], list[BlockJob]]:
        """Return jobs for the squares of a round, and for blocks, that `users` or counts need.

        What an earlier run with other inputs left is removed.
        """
        context, survey, part = self.run.context, self.run.survey, self.run.plan.rounds[number]
        grid, every, unit = context.grid_of(number + 1), self._points_of_squares, survey.unit
        names = {square: f"{square_name(context, number, square)}.npz" for square in every}
        self.run.store.remove(f".round{number}.npz", names.values())
        first = self.squares_without_record[number]
        squares = {square: self._square_job(number, square) for square in first}
        blocks: dict[tuple[int, int], BlockJob] = {}

        def squares_in(box: Box) -> list[TileJob]:
            places = sorted(every.keys() & survey.squares.covering(box))
            for place in places:
                squares[place] = squares.get(place) or self._square_job(number, place)
            return [squares[place] for place in places]

        far = self.run.farthest if self.run.plan.rounds[number + 1].halo_m else 0.0
        for job in users:
            box = grid.box(job.tile, far)
            job.needs = [*squares_in(box)] if part.saved else []
        if part.blocks is None:
            return list(squares.values()), []
        boxes = [survey.grid.box(job.tile) for job in self.run.tiles]
        places = {b for box in boxes for b in blocks_near(context, box, part.blocks.overhang)}
        self.run.store.remove(".block.npz", [f"{block_name(place)}.npz" for place in places])
        distance_m = self.run.farthest * unit + part.blocks.margin
        for job in users:
            near = blocks_near(context, grid.box(job.tile), distance_m)
            for place in sorted(places.intersection(near)):
                if place not in blocks:
                    # One meter more, as the box may be rounded.
                    box_m = TileGrid(part.blocks.side).box(place, part.blocks.reach + 1.0)
                    x0, y0, x1, y1 = (side / unit for side in box_m)
                    needed = squares_in((x0, y0, x1, y1))
                    digest = fingerprint(place, part.blocks, [each.digest for each in needed])
                    blocks[place] = BlockJob(
                        block_name(place), 1, place, needs=[*needed], digest=digest
                    )
                job.needs.append(blocks[place])
        return list(squares.values()), list(blocks.values())

    def _square_job(self, number: int, square: tuple[int, int]) -> TileJob:
        """Return the job of a square; its digest tells of all inputs that may matter."""
        survey, part = self.run.survey, self.run.plan.rounds[number]
        stages = self.run.plan.in_tiles[: part.end + (part.blocks is not None)]
        far = max(self.run.plan.sees_m / survey.unit if number else 0.0, self.run.farthest)
        box = survey.squares.box(square, far)
        digest = fingerprint(
            [build(), stages, survey.stamps_of(self.run.plan.files[: len(stages)])],
            [self.run.plan.shared_fields(), survey.system, vars(survey.grids), vars(part), square],
            [source.content for source in survey.near_box(box) if not source.fault],
        )
        name = square_name(self.run.context, number, square)
        return TileJob(name, self._points_of_squares[square], square, digest=digest)

    def _block_task(self, job: BlockJob) -> Task:
        """Return the task that computes a block."""
        squares = [self.run.store.path(each.name) for each in job.needs]
        return partial(
            make_block, self.run.context, job.block, squares, self.run.store.path(job.name)
        )
