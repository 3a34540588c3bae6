"""How a forest's trees lie in memory while they are walked: words that hold a node, and a table of the different leaves."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.hashing import hash_of
from ..base.runs import begins_run

#: Of 32 and 64 bits: the type of a node's two numbers, that of its threshold, and the bits of NaN that are free.
WORDS: tuple[tuple[Any, Any, int], ...] = ((np.uint32, np.float32, 22), (np.uint64, np.float64, 51))
#: Columns of the leaf table come in whole vectors of so many.
SPAN = 4


def walkable(sizes, feature, threshold, left, leaf_value, n_features: int) -> tuple[Any, ...]:
    """Trees as :func:`.walk.walk` takes them: in words of 32 bits where a feature and a child fit into one."""
    rows, table = _distinct(leaf_value)
    child_bits = int(sizes.max()).bit_length()
    fits = (n_features - 1).bit_length() + child_bits <= 32 and len(table) <= 1 << WORDS[0][2]
    word, real, free_bits = WORDS[0 if fits else 1]
    leaf = feature < 0
    limits = np.empty((len(feature), 2), real)
    limits[:, 0] = np.where(leaf, np.nan, threshold)
    nodes = limits.view(word)
    nodes[leaf, 0] |= rows.astype(word)
    nodes[:, 1] = np.where(leaf, 0, feature).astype(word) << word(child_bits) | left
    child, free = (word((1 << bits) - 1) for bits in (child_bits, free_bits))
    flat = nodes.reshape(-1), limits.reshape(-1)
    padded = np.zeros((len(table), -(-table.shape[1] // SPAN) * SPAN))
    padded[:, : table.shape[1]] = table
    return sizes.astype(np.int64), *flat, word(child_bits), child, free, padded.reshape(-1)


def _distinct(values: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """(row of the table for each row, table of the different rows): a forest's leaves are much alike."""
    hashes = hash_of(values.T, 0)
    order = np.argsort(hashes)
    new = begins_run(hashes[order])
    rows = np.empty(len(values), np.int64)
    rows[order] = np.cumsum(new) - 1
    table = values[order[new]]
    return (rows, table) if np.array_equal(table[rows], values) else (np.arange(len(values)), values)
