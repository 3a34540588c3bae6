"""PDAL's `where` expressions, evaluated on NumPy arrays.

PDAL hands a filter with `where` only the points inside. Our stages need the points outside
too, as neighbors, so they evaluate the expression themselves: comparisons
(``== != < <= > >=``), ``&&``, ``||``, ``!``, arithmetic, parentheses and PDAL's functions over
dimension names and numbers, with PDAL's precedence. What any PDAL from 2.2 to 2.10 takes is taken
here with the same meaning, whatever PDAL is at hand; some of them refuse a little more:
``(X + Y) == X`` and ``(Z) > 2`` the newer ones, functions those before 2.7 or 2.9.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import DimensionError, OptionError, suggest

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<mark>&&|\|\||==|!=|<=|>=|[-+*/()<>!]))"
)
_COMPARISONS = ("==", "!=", "<", "<=", ">", ">=")
_LEVELS: tuple[tuple[str, ...], ...] = (("||",), ("&&",), _COMPARISONS, ("+", "-"), ("*", "/"))
_BOOLEAN = _LEVELS[0] + _LEVELS[1]
_DEEPEST = 100


def _divide(a, b):
    """PDAL's division: by zero it gives NaN, not infinity."""
    return np.where(np.equal(b, 0), np.nan, np.divide(a, b))


def _round(a):
    """C's rounding, halves away from zero."""
    whole = np.trunc(a)
    return np.where(np.abs(a - whole) >= 0.5, whole + np.sign(a), whole)


_OPERATIONS: dict[str, Callable] = {
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
    "/": _divide,
}
_LIMITS = np.finfo(np.float64)
_CONSTANTS = {"nan": np.nan, "lowest": float(_LIMITS.min), "highest": float(_LIMITS.max)}
_CONDITIONS: dict[str, Callable] = {
    "isnan": np.isnan,
    "ismin": lambda a: np.equal(a, _LIMITS.min),
    "ismax": lambda a: np.equal(a, _LIMITS.max),
}
_FUNCTIONS: dict[str, Callable] = {
    **{
        name: getattr(np, name)
        for name in ("floor", "ceil", "fabs", "sqrt", "sin", "cos", "tan", "sinh", "cosh")
    },
    **{name: getattr(np, name) for name in ("tanh", "log", "log2", "log10", "exp", "exp2")},
    **{name: getattr(np, f"arc{name[1:]}") for name in ("asin", "acos", "atan", "asinh", "acosh")},
    "abs": np.abs,
    "round": _round,
}
#: Other names that PDAL takes for dimensions, in small letters.
_ALIASES = {
    "class": "Classification",
    "cls": "Classification",
    "hag": "HeightAboveGround",
    "nearinfrared": "Infrared",
    "scanangle": "ScanAngleRank",
}


@dataclass(frozen=True)
class _Node:
    """A function with its operands, a dimension name, or a number; `truth` marks booleans."""

    kind: str
    value: Any
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
        position, end = 0, len(text.rstrip())
        while position < end:
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
        self._names: set[str] = set()
        self._root = self._level(0)
        if self._at < len(self._tokens):
            kind, word, place = self._tokens[self._at]
            raise self._error(f"'{word}' is not expected here", place)
        if not self._root.truth:
            raise self._error("it gives a number, not true or false", 0)
        self.dimensions = tuple(sorted(self._names))

    def evaluate(self, arrays: Mapping[str, NDArray]) -> NDArray[np.bool_]:
        """The mask of points for which the expression holds.

        Raises
        ------
        DimensionError
            If it names a dimension the points do not have.
        """
        values = {name: arrays[_find(name, arrays)] for name in self.dimensions}
        size = len(next(iter(arrays.values()))) if arrays else 0
        with np.errstate(all="ignore"):
            return np.broadcast_to(np.asarray(_value(self._root, values), bool), (size,)).copy()

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
            if (left.truth, right.truth) != (mark in _BOOLEAN,) * 2:
                raise self._error(f"'{mark}' does not fit its two sides", place)
            left = _Node("operation", _OPERATIONS[mark], (left, right), truth=level < 3)
        return left

    def _unary(self) -> _Node:
        if self._at >= len(self._tokens):
            raise self._error("it ends too early", len(self.text))
        kind, word, place = self._tokens[self._at]
        self._at += 1
        if kind == "number":
            return _Node("number", float(word))
        if kind == "name" and self._peek() != "(":
            self._names.add(word)
            return _Node("name", word)
        self._depth += 1
        if self._depth > _DEEPEST:
            raise self._error("it is nested too deeply", place)
        try:
            if kind == "name":
                return self._call(word, place)
            if word == "(":
                return self._closed(self._level(0), place)
            if word == "!":
                # PDAL: before a comparison without parentheses it turns that round as a whole.
                operand = self._unary() if self._peek() in ("(", "!") else self._level(2)
                if not operand.truth:
                    raise self._error("'!' needs a condition after it, in parentheses", place)
                return _Node("call", np.logical_not, (operand,), truth=True)
            if word == "-":
                operand = self._unary()
                if operand.truth:
                    raise self._error("'-' needs a number after it", place)
                return _Node("call", np.negative, (operand,))
        finally:
            self._depth -= 1
        raise self._error(f"'{word}' is not expected here", place)

    def _closed(self, inner: _Node, place: int) -> _Node:
        if self._peek() != ")":
            raise self._error("a ')' is missing", place)
        self._at += 1
        return inner

    def _call(self, name: str, place: int) -> _Node:
        """A function of one number, or a constant of PDAL's."""
        self._at += 1  # the parenthesis
        if name in _CONSTANTS:
            return self._closed(_Node("number", _CONSTANTS[name]), place)
        called = _FUNCTIONS.get(name) or _CONDITIONS.get(name)
        if called is None:
            known = [*_FUNCTIONS, *_CONDITIONS, *_CONSTANTS]
            raise self._error(f"'{name}' is not a function; known are {', '.join(known)}", place)
        argument = self._level(0)
        if argument.truth:
            raise self._error(f"'{name}' needs a number", place)
        return self._closed(_Node("call", called, (argument,), truth=name in _CONDITIONS), place)


def _find(name: str, arrays: Mapping[str, NDArray]) -> str:
    """The dimension a name means: PDAL takes known ones in any case, and some by another name."""
    if name in arrays:
        return name
    wanted = _ALIASES.get(name.lower(), name).lower()
    for known in arrays:
        if known.lower() == wanted:
            return known
    raise DimensionError(
        f"'where' names the dimension '{name}', which the points do not have",
        found=", ".join(arrays),
        cure=suggest(name, arrays) or None,
    )


def _value(node: _Node, arrays: Mapping[str, NDArray]):
    chain = []  # a row of terms, as long as it may be, is nested to the left
    while node.kind == "operation":
        chain.append(node)
        node = node.parts[0]
    value = _operand(node, arrays)
    for operation in reversed(chain):
        value = operation.value(value, _value(operation.parts[1], arrays))
    return value


def _operand(node: _Node, arrays: Mapping[str, NDArray]):
    if node.kind == "number":
        return node.value
    if node.kind == "name":
        return np.asarray(arrays[node.value], np.float64)
    return node.value(_value(node.parts[0], arrays))
