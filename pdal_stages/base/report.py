"""What a stage, a prediction or the feature engine reports besides its results."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass
class Report:
    """What a stage, a prediction or the feature engine reports besides its results."""

    #: counts and other JSON-able values by name, e.g. ``points`` or ``classes``
    figures: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)  #: what the user should know; nothing is wrong
    warnings: list[str] = field(default_factory=list)  #: what is likely wrong, and the cure
    #: By neighborhood, the points whose nearest neighbors lay farther away than the halo: in a tile of that halo their
    #: values may differ from those of the whole cloud.
    beyond_halo: dict[str, int] = field(default_factory=dict)
    reach: float = 0.0  #: how far away the farthest of these lay, in meters; not in the metadata
    #: the points of each class code after a stage that gives classes, whichever it looked at; not in the metadata
    codes: dict[str, int] | None = None

    def merge(self, other: Report) -> None:
        """Merge another report into this one. Existing figures are kept; dicts are merged by key."""
        _merge(self.figures, other.figures)
        _merge(self.beyond_halo, other.beyond_halo)
        self.reach = max(self.reach, other.reach)
        for mine, theirs in ((self.notes, other.notes), (self.warnings, other.warnings)):
            mine += [text for text in theirs if text not in mine]

    @property
    def messages(self) -> list[str]:
        """Warnings, then notes."""
        return [*self.warnings, *self.notes]

    def to_dict(self) -> dict[str, Any]:
        """The report as metadata: figures, and ``beyond_halo``, ``warning`` and ``note`` where there are any."""
        texts = {"warning": self.warnings, "note": self.notes}
        return (
            self.figures
            | ({"beyond_halo": self.beyond_halo} if self.beyond_halo else {})
            | {name: ". ".join(lines) for name, lines in texts.items() if lines}
        )


def _merge(mine: dict[str, Any], theirs: dict[str, Any]) -> None:
    for name, value in theirs.items():
        if isinstance(value, dict) and isinstance(mine.get(name), dict):
            mine[name] = {**value, **mine[name]}
        else:
            mine.setdefault(name, dict(value) if isinstance(value, dict) else value)
