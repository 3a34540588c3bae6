"""What a stage, a prediction or the feature engine reports besides its results."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass
class Report:
    """Counts, notes and warnings of a run."""

    #: JSON-able values by name, e.g. ``points`` or ``classes``
    figures: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)  #: what the user should know; nothing is wrong
    warnings: list[str] = field(default_factory=list)  #: what is likely wrong, and the cure
    #: By neighborhood, the points whose nearest neighbors lay farther away than the halo: in a tile
    #: of that halo their values may differ from those of the whole cloud.
    beyond_halo: dict[str, int] = field(default_factory=dict)
    reach: float = 0.0  #: meters to the farthest of these neighbors; not in the metadata
    #: number of points of each class code, after a stage that gives classes; not in the metadata
    codes: dict[str, int] | None = None

    def merge(self, other: Report) -> None:
        """Merge another report into this one. Existing figures stay; dicts are merged by key.

        ``codes`` are not merged: those of the last stage count, which its own report holds.
        """
        _merge(self.figures, other.figures)
        _merge(self.beyond_halo, other.beyond_halo)
        self.reach = max(self.reach, other.reach)
        for texts, more in ((self.notes, other.notes), (self.warnings, other.warnings)):
            texts += [text for text in more if text not in texts]

    @property
    def messages(self) -> list[str]:
        """Warnings, then notes."""
        return [*self.warnings, *self.notes]

    def to_dict(self) -> dict[str, Any]:
        """Return the metadata: figures and, if any, ``beyond_halo``, ``warning`` and ``note``."""
        texts = {"warning": self.warnings, "note": self.notes}
        return (
            self.figures
            | ({"beyond_halo": self.beyond_halo} if self.beyond_halo else {})
            | {name: ". ".join(lines) for name, lines in texts.items() if lines}
        )


def _merge(target: dict[str, Any], source: dict[str, Any]) -> None:
    for name, value in source.items():
        if isinstance(value, dict) and isinstance(target.get(name), dict):
            target[name] = {**value, **target[name]}
        else:
            target.setdefault(name, dict(value) if isinstance(value, dict) else value)
