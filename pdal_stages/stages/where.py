"""PDAL's `where` expressions, evaluated on NumPy arrays.

PDAL hands a filter with `where` only the points inside. Our stages need the points outside
too, as neighbors, so they evaluate the expression themselves: comparisons
(``== != < <= > >=``), ``&&``, ``||``, ``!``, arithmetic and parentheses over dimension
names and numbers, with PDAL's precedence.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.errors import DimensionError, OptionError, suggest

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<mark>&&|\|\||==|!=|<=|>=|[-+*/()<>!]))"
)
_LEVELS: tuple[tuple[str, ...], ...] = (
    ("||",),
    ("&&",),
    ("==", "!="),
    ("<", "<=", ">", ">="),
    ("+", "-"),
    ("*", "/"),
)
_OPERATIONS = {
    "||": np.logical_or,
    "&&": np.logical_and,
    "==": np.equal,
    "!=": np.not_equal,
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": np.divide,
}
_BOOLEAN = {"||", "&&"}
_DEEPEST = 100


@dataclass(frozen=True)
class _Node:
    """An operator with its operands, a dimension name, or a number; `truth` marks booleans."""

    kind: str
    value: object = None
    parts: tuple[_Node, ...] = ()
    truth: bool = False


class Expression:
    """A parsed `where` expression.

    Parameters
    ----------
    text : str
        E.g. ``"Classification == 2 && Z > 3"``.

    Raises
    ------
    OptionError
        If it cannot be parsed; the message points at the place.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        self._tokens: list[tuple[str, str, int]] = []
        position = 0
        while position < len(text) and text[position:].strip():
            match = _TOKEN.match(text, position)
            if match is None:
                while text[position].isspace():
                    position += 1
                raise self._error(f"'{text[position]}' is not understood", position)
            kind = str(match.lastgroup)
            self._tokens.append((kind, match.group(kind), match.start(kind)))
            position = match.end()
        self._at = 0
        self._depth = 0
        self._root = self._level(0)
        if self._at < len(self._tokens):
            kind, word, place = self._tokens[self._at]
            raise self._error(f"'{word}' is not expected here", place)
        if not self._root.truth:
            raise self._error("it gives a number, not true or false", 0)
        self.dimensions = tuple(sorted(_names(self._root)))

    def evaluate(self, arrays: Mapping[str, NDArray]) -> NDArray[np.bool_]:
        """The mask of points for which the expression holds.

        Raises
        ------
        DimensionError
            If it names a dimension the points do not have.
        """
        for name in self.dimensions:
            if name not in arrays:
                raise DimensionError(
                    f"'where' names the dimension '{name}', which the points do not have",
                    found=", ".join(arrays),
                    cure=suggest(name, arrays) or None,
                )
        size = len(next(iter(arrays.values()))) if arrays else 0
        with np.errstate(all="ignore"):
            return np.broadcast_to(np.asarray(_value(self._root, arrays), bool), (size,)).copy()

    def _error(self, what: str, place: int) -> OptionError:
        return OptionError(
            f"the 'where' expression cannot be read: {what}, at character {place + 1}",
            found=repr(self.text),
            cure='Example: "Classification == 2 && Z > 3"',
        )

    def _peek(self) -> str:
        return self._tokens[self._at][1] if self._at < len(self._tokens) else ""

    def _level(self, level: int) -> _Node:
        if level == len(_LEVELS):
            return self._unary()
        left = self._level(level + 1)
        while self._peek() in _LEVELS[level]:
            place = self._tokens[self._at][2]
            mark = self._peek()
            self._at += 1
            right = self._level(level + 1)
            if (mark in _BOOLEAN) != (left.truth and right.truth) and mark not in ("==", "!="):
                raise self._error(f"'{mark}' does not fit its two sides", place)
            left = _Node("op", mark, (left, right), truth=level < 4)
        return left

    def _unary(self) -> _Node:
        if self._at >= len(self._tokens):
            raise self._error("it ends too early", len(self.text))
        kind, word, place = self._tokens[self._at]
        self._at += 1
        if kind == "number":
            return _Node("number", float(word))
        if kind == "name":
            return _Node("name", word)
        self._depth += 1
        if self._depth > _DEEPEST:
            raise self._error("it is nested too deeply", place)
        try:
            if word == "(":
                inner = self._level(0)
                if self._peek() != ")":
                    raise self._error("a ')' is missing", place)
                self._at += 1
                return inner
            if word == "!":
                operand = self._unary()
                if not operand.truth:
                    raise self._error("'!' needs a condition after it, in parentheses", place)
                return _Node("not", None, (operand,), truth=True)
            if word == "-":
                return _Node("minus", None, (self._unary(),))
        finally:
            self._depth -= 1
        raise self._error(f"'{word}' is not expected here", place)


def _names(node: _Node) -> set[str]:
    if node.kind == "name":
        return {str(node.value)}
    return set().union(*(_names(part) for part in node.parts)) if node.parts else set()


def _value(node: _Node, arrays: Mapping[str, NDArray]):
    if node.kind == "number":
        return node.value
    if node.kind == "name":
        return np.asarray(arrays[str(node.value)], np.float64)
    parts = [_value(part, arrays) for part in node.parts]
    if node.kind == "not":
        return np.logical_not(parts[0])
    if node.kind == "minus":
        return np.negative(parts[0])
    return _OPERATIONS[str(node.value)](*parts)
