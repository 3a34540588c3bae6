"""Class labels: checked, counted in pairs, merged and named, for comparing two classifications."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base import checks
from ..base.asprs import NAMES, class_name
from ..base.errors import StageError

#: The largest label; LAS itself stops at 255, other dimensions that hold classes do not.
MAX_LABEL = 65535
#: A dimension with more different values than this is not a class dimension.
MAX_CLASSES = 256
#: Points looked at in one go, which bounds the memory.
CHUNK = 1 << 20


def as_codes(labels: npt.ArrayLike, what: str) -> npt.NDArray[Any]:
    """The labels as an (n,) uint16 array, or an error that says what is wrong with them."""
    a = np.asarray(labels)
    if a.ndim != 1:
        raise StageError(f"the {what} must be one label per point", found=f"shape {a.shape}")
    if a.size and a.dtype.kind not in "iuf":
        raise StageError(
            f"the {what} is not a list of class codes", found=f"values of type {a.dtype}"
        )
    bad = (a < 0) | (a > MAX_LABEL) if a.size else np.zeros(0, bool)
    if a.dtype.kind == "f":
        bad |= a != np.floor(a)
    if bad.any():
        raise StageError(
            f"the {what} has values that are not class codes",
            found=a[bad][0],
            cure=f"Class codes are whole numbers from 0 to {MAX_LABEL}: choose a class dimension",
        )
    return a.astype(np.uint16, copy=False)


def same_length(reference: npt.NDArray[Any], others: Mapping[str, npt.NDArray[Any]]) -> None:
    """Refuse arrays that are not as long as the reference; `others` says what each is."""
    for what, values in others.items():
        if len(values) != len(reference):
            raise StageError(
                f"the {what} has a different length than the reference",
                found=f"{len(values):,} and {len(reference):,} values",
                cure="Compare two classifications of the same points, in the same order",
            )


def code_of(what: str, value: Any, most: int = MAX_LABEL) -> int:
    """A class code; digits as text (JSON keys) are allowed."""
    if isinstance(value, str) and value.strip().isdecimal():
        value = int(value)
    return checks.whole(what, value, 0, most)


def code_list(codes: Iterable[Any], option: str) -> list[int]:
    """Class codes as ints."""
    return [code_of(f"a class in '{option}'", code) for code in codes]


def class_names(codes: Iterable[int], given: Mapping[Any, str] | None) -> dict[int, str]:
    """The names of codes: those given, whose keys may be text, then ASPRS's own."""
    own = (
        dict(zip(code_list(given, "names"), map(str, given.values()), strict=True)) if given else {}
    )
    return {code: own.get(code) or class_name(code) for code in sorted(set(codes))}


@dataclass(frozen=True)
class Merge:
    """Classes taken as one, on both sides of a comparison."""

    target_of: npt.NDArray[np.int64]  #: (65536,) the class that every code becomes
    names: dict[int, str]  #: of the classes made of several

    @classmethod
    def parse(cls, mapping: Mapping[Any, Any] | None) -> Merge:
        """Read ``{5: [3, 4]}``; keys and codes may be text.

        StageError for what is not a list of class codes, or a class sent to two others.
        """
        to = np.arange(MAX_LABEL + 1)
        members: dict[int, set[int]] = {}
        for key, value in (mapping or {}).items():
            if not isinstance(value, list | tuple | set | np.ndarray):
                raise StageError(
                    "'merge' maps a class to a list of classes",
                    found=repr(value),
                    cure="As in {5: [3, 4]}",
                )
            (target,), sources = code_list([key], "merge"), code_list(value, "merge")
            for source in sources:
                if to[source] not in (source, target):
                    raise StageError(
                        "'merge' maps one class to two others",
                        found=f"class {source} to {to[source]} and {target}",
                    )
                to[source] = target
            members.setdefault(target, set()).update(sources)
        names = {}
        for target, codes in members.items():
            # An ASPRS target keeps its own points (3, 4 -> 5); a user's own code is a new class.
            if target in NAMES and to[target] == target:
                codes.add(target)
            if len(codes) > 1:
                words = {class_name(code).split()[-1] for code in codes}
                # Low, medium and high vegetation are vegetation; others have no word in common.
                common = len(words) == 1 and all(code in NAMES for code in codes)
                listed = ", ".join(map(str, sorted(codes)))
                names[target] = words.pop().capitalize() if common else f"Classes {listed}"
        return cls(to, names)

    @property
    def changed(self) -> dict[int, int]:
        """The codes that become another class, and which."""
        codes = np.flatnonzero(self.target_of != np.arange(len(self.target_of)))
        return {int(code): int(self.target_of[code]) for code in codes}


def pair_counts(
    reference: npt.NDArray[Any], predicted: npt.NDArray[Any]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Codes of the reference (R,) and of the prediction (C,), ascending, and how often each pair occurs (R, C)."""
    codes, positions = [], []
    for what, labels in (("reference", reference), ("prediction", predicted)):
        there = np.zeros(MAX_LABEL + 1, bool)
        there[labels] = True
        codes.append(np.flatnonzero(there))
        positions.append(np.cumsum(there) - 1)
        if len(codes[-1]) > MAX_CLASSES:
            raise StageError(
                f"the {what} has too many different values for class codes",
                found=f"{len(codes[-1]):,} values",
                cure="Check which dimension is compared",
            )
    (rows, columns), (row_of, column_of) = codes, positions
    counts = np.zeros(len(rows) * len(columns), np.int64)
    for start in range(0, len(reference), CHUNK):
        part = slice(start, start + CHUNK)
        pairs = row_of[reference[part]] * len(columns) + column_of[predicted[part]]
        counts += np.bincount(pairs, minlength=len(counts))
    return rows, columns, counts.reshape(len(rows), len(columns))


def regroup(
    rows: Sequence[int], *tables: tuple[npt.NDArray[np.int64], Iterable[int], Iterable[int]]
) -> tuple[tuple[int, ...], npt.NDArray[np.int64]]:
    """One matrix of several tables of counts with the classes of their rows and columns, those of one class added up.

    Its columns are `rows`, among which every table's are, then the other classes of the tables' columns, ascending.
    """
    columns = (*rows, *sorted({int(c) for _, _, given in tables for c in given} - set(rows)))
    place = {code: k for k, code in enumerate(columns)}
    out = np.zeros((len(rows), len(columns)), np.int64)
    for counts, *sides in tables:
        i, j = (np.array([place[int(c)] for c in side], dtype=int) for side in sides)
        np.add.at(out, (i[:, None], j[None, :]), counts)
    return columns, out
