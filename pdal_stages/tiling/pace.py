"""How long a run will still take, told from what its own tasks have taken."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class _Kind:
    """Tasks of one kind: tiles, or outputs put together from them."""

    left: int = 0  #: points of those not done yet
    done: int = 0  #: points of those done here
    seconds: float = 0.0  #: that those took, of one worker each
    tasks: int = 0  #: how many those are


class Pace:
    """Time left of a run with several workers.

    What tasks took is asked, not the time since the run began: workers start late and compile, and an earlier run may have
    done a part.

    Parameters
    ----------
    tiles, outputs : int
        Points that wait in tiles, and in outputs that are put together from them (0 where tiles are outputs).
    slots : int
        Workers.
    """

    def __init__(self, tiles: int, outputs: int, slots: int) -> None:
        self._kinds = {"tile": _Kind(tiles), "output": _Kind(outputs)}
        self.slots = max(1, slots)

    def finished(self, kind: str, points: int, seconds: float) -> None:
        """A task is done, or given up."""
        one = self._kinds[kind]
        one.left = max(0, one.left - points)
        one.tasks += 1
        if one.tasks == self.slots + 1:  # the first of each worker loaded and compiled: forget them
            one.done, one.seconds = 0, 0.0
        one.done += points
        one.seconds += seconds

    def seconds_left(self) -> float | None:
        """None where nothing is known yet."""
        total = 0.0
        rate = self._kinds["tile"].seconds / self._kinds["tile"].done if self._kinds["tile"].done else None
        for kind, one in self._kinds.items():
            if not one.left:
                continue
            # Before the first output is put together, a tenth of the time of tiles is assumed: what it usually takes.
            each = one.seconds / one.done if one.done else (rate * 0.1 if rate and kind == "output" else None)
            if each is None:
                return None
            total += one.left * each
        return total / self.slots
