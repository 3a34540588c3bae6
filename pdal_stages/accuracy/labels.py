"""Class labels: checked, listed, counted, merged and looked up, for comparing two of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.asprs import NAMES, class_name
from ..base.errors import StageError

#: Largest class code; LAS itself stops at 255, other label dimensions do not.
MAX_CODE = 65535
#: A dimension with more different values than this is no class dimension.
MAX_CLASSES = 256
#: Points looked at in one go, which bounds the memory.
CHUNK = 1 << 20


def as_codes(labels: npt.ArrayLike, what: str) -> npt.NDArray[Any]:
    """The labels as an integer array, or an error that says what is wrong with them."""
    a = np.asarray(labels)
    if a.ndim != 1:
        raise StageError(f"the {what} must be one label per point", found=f"shape {a.shape}")
    if a.dtype.kind == "f":
        bad = ~(np.isfinite(a) & (a == np.floor(a)))
        if bad.any():
            raise StageError(
                f"the {what} has values that are no class codes",
                found=a[bad][0],
                cure="Compare a class dimension",
            )
        a = a.astype(np.int64)
    elif a.dtype.kind not in "iu" and a.size:
        raise StageError(f"the {what} is not a list of class codes", found=f"values of type {a.dtype}")
    elif not a.size:
        a = a.astype(np.int64)
    if a.size and (a.min() < 0 or a.max() > MAX_CODE):
        raise StageError(
            f"the {what} has values that are no class codes",
            found=f"{a.min()} to {a.max()}",
            cure=f"Class codes are whole numbers from 0 to {MAX_CODE}",
        )
    return a.astype(np.int64) if a.dtype.itemsize == 8 else a


def same_length(reference: npt.NDArray[Any], others: Mapping[str, npt.NDArray[Any]]) -> None:
    for what, values in others.items():
        if len(values) != len(reference):
            raise StageError(
                f"the {what} has another length than the reference",
                found=f"{len(values):,} and {len(reference):,} values",
                cure="Compare two classifications of the same points, in the same order",
            )


def code_list(codes: Iterable[Any], what: str) -> list[int]:
    """Class codes as ints; strings of digits (JSON keys) are allowed."""
    out = []
    for code in codes:
        try:
            value = int(code)
            good = value == (int(code) if isinstance(code, str) else code) and 0 <= value <= MAX_CODE
        except (TypeError, ValueError):
            good = False
        if not good or isinstance(code, bool):
            raise StageError(f"'{what}' has something that is no class code", found=repr(code))
        out.append(value)
    return out


def int_keys(names: Mapping[Any, str] | None) -> dict[int, str]:
    return dict(zip(code_list(names, "names"), map(str, names.values()), strict=True)) if names else {}


def merging(mapping: Mapping[Any, Any] | None) -> tuple[npt.NDArray[np.int64], dict[int, str]]:
    """The class every code becomes, and names for the merged classes."""
    to = np.arange(MAX_CODE + 1)
    parts: dict[int, set[int]] = {}
    for key, value in (mapping or {}).items():
        if isinstance(value, (str, int, np.integer)):
            (target,), sources = code_list([value], "merge"), code_list([key], "merge")
        else:
            (target,), sources = code_list([key], "merge"), code_list(value, "merge")
        for source in sources:
            if to[source] not in (source, target):
                raise StageError(
                    "'merge' sends one class to two others",
                    found=f"class {source} to {to[source]} and {target}",
                )
            to[source] = target
        parts.setdefault(target, set()).update(sources)
    called = {}
    for target, sources_of in parts.items():
        # An ASPRS target keeps its own points (3, 4 -> 5); a user's own code is a new class.
        members = sorted(sources_of | ({target} if target in NAMES and to[target] == target else set()))
        if len(members) > 1:
            words = {class_name(code).split()[-1] for code in members}
            # Low, medium and high vegetation are vegetation; others have no word in common.
            common = len(words) == 1 and all(code in NAMES for code in members)
            called[target] = words.pop().capitalize() if common else f"Classes {', '.join(map(str, members))}"
    return to, called


def moved(to: npt.NDArray[np.int64]) -> dict[int, int]:
    """The codes a merge changes, and what they become."""
    return {int(code): int(to[code]) for code in np.flatnonzero(to != np.arange(len(to)))}


def present(
    codes: npt.NDArray[Any], to: npt.NDArray[np.int64], where: Callable | None = None
) -> dict[int, int]:
    """Merged code to count, over all points or those `where` says."""
    counts = np.zeros(MAX_CODE + 1, np.int64)
    for start in range(0, len(codes), CHUNK):
        part = slice(start, start + CHUNK)
        chosen = codes[part] if where is None else codes[part][where(part)]
        found = np.bincount(chosen)
        counts[: len(found)] += found
    merged = np.zeros(MAX_CODE + 1, np.int64)
    np.add.at(merged, to, counts)
    return {int(code): int(merged[code]) for code in np.flatnonzero(merged)}


def mask(reference: npt.NDArray[Any], to: npt.NDArray[np.int64], rows: Sequence[int]) -> Callable:
    """A function: which points of a slice have a compared reference class."""
    wanted = np.zeros(MAX_CODE + 1, bool)
    wanted[list(rows)] = True
    wanted = wanted[to]
    return lambda part: wanted[reference[part]]


def lookup(codes: Sequence[int], to: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Code to position in `codes` after merging, -1 for the others."""
    place = np.full(MAX_CODE + 1, -1, np.int64)
    place[list(codes)] = np.arange(len(codes))
    return place[to]


def placed(
    matrix: npt.NDArray[np.int64],
    row_codes: Sequence[int],
    column_codes: Sequence[int],
    rows: Sequence[int],
    columns: Sequence[int],
) -> npt.NDArray[np.int64]:
    """The matrix moved onto other (or merged) rows and columns."""
    out = np.zeros((len(rows), len(columns)), np.int64)
    i = np.array([rows.index(int(c)) for c in row_codes], dtype=int)
    j = np.array([columns.index(int(c)) for c in column_codes], dtype=int)
    np.add.at(out, (i[:, None], j[None, :]), matrix)
    return out


def named(codes: Iterable[int], given: Mapping[int, str]) -> dict[int, str]:
    return {code: given.get(code) or class_name(code) for code in sorted(set(codes))}


def listing(found: Mapping[int, int]) -> str:
    return ", ".join(f"{code}: {n:,}" for code, n in sorted(found.items())[:12]) + (
        ", ..." if len(found) > 12 else ""
    )
