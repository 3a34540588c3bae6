"""Class labels of two classifications: check, merge, name and count them in pairs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..base import checks
from ..base.asprs import HIGH_VEGETATION, LOW_VEGETATION, MEDIUM_VEGETATION, NAMES, UNINFORMATIVE
from ..base.errors import StageError

#: Largest label: that of uint16; Classification itself ends at 255.
MAX_LABEL = 65535
#: A dimension with more different values than this is not a class dimension: Classification, of one
#: byte, has no more.
MAX_CLASSES = 256
#: Points counted at a time, whose pairs take some 30 MB. Not tuned.
CHUNK = 1 << 20


def as_codes(labels: npt.ArrayLike, what: str) -> npt.NDArray:
    """Return labels as an (n,) uint16 array; StageError, which calls them `what`, for others."""
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


def refuse_other_lengths(reference: npt.NDArray, others: Mapping[str, npt.NDArray]) -> None:
    """Raise StageError for an array, by its name, that is not as long as the reference."""
    for what, values in others.items():
        if len(values) != len(reference):
            raise StageError(
                f"the {what} has a different length than the reference",
                found=f"{len(values):,} and {len(reference):,} values",
                cure="Compare two classifications of the same points, in the same order",
            )


def code_of(what: str, value: object, most: int = MAX_LABEL) -> int:
    """Return a class code; digits as text (JSON keys) are allowed."""
    if isinstance(value, str) and value.strip().isdecimal():
        value = int(value)
    return checks.whole(what, value, 0, most)


def code_list(codes: Iterable[object], option: str) -> list[int]:
    """Return class codes as ints."""
    return [code_of(f"a class in '{option}'", code) for code in codes]


@dataclass(frozen=True)
class Merge:
    """Classes taken as one, on both sides of a comparison."""

    target_of: npt.NDArray[np.int64]  #: (65536,) the class that each code becomes
    names: dict[int, str]  #: names of merged classes

    @classmethod
    def parse(cls, mapping: Mapping[object, object] | None) -> Merge:
        """Read a mapping ``{5: [3, 4]}``; keys and codes may be text.

        Raises
        ------
        StageError
            For values that are not lists of class codes, or a class merged into two others.
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
            # A target of ASPRS keeps its points (3, 4 -> 5); a code of the user is a new class.
            if target in NAMES and to[target] == target:
                codes.add(target)
            if len(codes) > 1:
                listed = ", ".join(map(str, sorted(codes)))
                names[target] = (
                    "Vegetation"
                    if codes <= {LOW_VEGETATION, MEDIUM_VEGETATION, HIGH_VEGETATION}
                    else f"Classes {listed}"
                )
        return cls(to, names)

    @property
    def changed(self) -> dict[int, int]:
        """The codes that become another class, and that class."""
        codes = np.flatnonzero(self.target_of != np.arange(len(self.target_of)))
        return {int(code): int(self.target_of[code]) for code in codes}


@dataclass(frozen=True)
class ComparedClasses:
    """The classes that a comparison is about."""

    #: classes of the reference to compare, after merging; points of other classes are left out and
    #: counted. By default every class that occurs
    classes: Iterable[int] | None = None
    names: Mapping[object, str] | None = None  #: code to name, where it is not ASPRS's
    #: reference codes, before merging, whose points are left out and counted. By default those that
    #: training leaves out: 0 and 1 (unclassified), 7 and 18 (noise), 12 (overlap); none where
    #: `classes` is set
    ignore: Iterable[int] | None = None
    #: classes to take as one, on both sides: ``{5: [3, 4]}``
    merge: Mapping[object, object] | None = None

    def select(
        self, codes: npt.NDArray[np.int64], merge: Merge
    ) -> tuple[tuple[int, ...], npt.NDArray[np.bool_]]:
        """Return the classes to compare, and which codes (n,) of the reference belong to them."""
        default = UNINFORMATIVE if self.classes is None else ()
        ignored = default if self.ignore is None else self.ignore
        kept = ~np.isin(codes, code_list(ignored, "ignore"))
        if self.classes is None:
            return tuple(np.unique(merge.target_of[codes[kept]]).tolist()), kept
        rows = tuple(sorted(set(code_list(self.classes, "classes"))))
        return rows, kept & np.isin(merge.target_of[codes], rows)


def pair_counts(
    reference: npt.NDArray, predicted: npt.NDArray
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Count pairs of labels.

    Returns
    -------
    rows, columns : (R,), (C,) int64
        Codes of the reference and of the prediction, ascending.
    counts : (R, C) int64
        Points of each pair.
    """
    codes, positions = [], []
    for what, labels in (("reference", reference), ("prediction", predicted)):
        occurs = np.zeros(MAX_LABEL + 1, bool)
        occurs[labels] = True
        codes.append(np.flatnonzero(occurs))
        positions.append(np.cumsum(occurs) - 1)
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


def sum_tables(
    rows: Sequence[int], *tables: tuple[npt.NDArray[np.int64], Iterable[int], Iterable[int]]
) -> tuple[tuple[int, ...], npt.NDArray[np.int64]]:
    """Add tables of counts, each with the classes of its rows and of its columns.

    Returns
    -------
    columns : tuple of int
        `rows`, among which the rows of every table are, then other classes of columns, ascending.
    matrix : (rows, columns) int64
    """
    columns = (*rows, *sorted({int(c) for *_, classes in tables for c in classes} - set(rows)))
    place = {code: k for k, code in enumerate(columns)}
    out = np.zeros((len(rows), len(columns)), np.int64)
    for counts, *sides in tables:
        i, j = (np.array([place[int(c)] for c in side], dtype=int) for side in sides)
        np.add.at(out, (i[:, None], j[None, :]), counts)
    return columns, out
