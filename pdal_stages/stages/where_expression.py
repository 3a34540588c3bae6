"""Conditions of the option `where`, such as ``Classification == 2 && Z > 3``.

PDAL hands a filter with `where` only the points inside; our stages need those outside too, as
neighbors, so they evaluate the condition themselves, with the meaning that PDAL gives it. Functions
(PDAL 2.7 and later) are not read.
"""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import DimensionError, OptionError, suggest

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<mark>&&|\|\||==|!=|<=|>=|[-+*/()<>!]))",
    re.ASCII,
)
#: PDAL's operator -> Python's.
_IN_PYTHON = {"&&": "and", "||": "or", "!": "not"}


def _divide(a, b):
    """Divide as PDAL does: by zero it gives NaN, not infinity."""
    return np.where(np.equal(b, 0), np.nan, np.divide(a, b))


#: Operators on numbers, and on truth values.
_OF_NUMBERS: dict[type, Callable] = {
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: _divide,
    ast.USub: np.negative,
}
_OF_TRUTHS: dict[type, Callable] = {
    ast.And: np.logical_and,
    ast.Or: np.logical_or,
    ast.Not: np.logical_not,
}
#: Other names that PDAL takes for dimensions, in small letters.
_ALIASES = {
    "class": "Classification",
    "cls": "Classification",
    "hag": "HeightAboveGround",
    "nearinfrared": "Infrared",
    "scanangle": "ScanAngleRank",
}
_Values = Mapping[str, NDArray]


class Expression:
    """A `where` expression, such as ``Classification == 2 && Z > 3``, read by Python's own parser.

    Raises
    ------
    OptionError
        If it cannot be read; the message points at the place.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        python = ""
        # Where in the text the characters of the Python expression come from.
        self._places: list[int] = []
        position, end = 0, len(text.rstrip())
        while position < end:
            match = _TOKEN.match(text, position)
            if match is None:
                position += len(text[position:]) - len(text[position:].lstrip())
                raise self._error(f"'{text[position]}' is not understood", position)
            kind = str(match.lastgroup)
            word = _IN_PYTHON.get(match[kind], match[kind])
            if kind == "number":
                word = repr(float(word)).replace("inf", "1e999")
            elif kind == "name":
                word = f"_{word}"  # some are words of Python
            python += f"{word} "
            self._places += [match.start(kind)] * (len(word) + 1)
            position = match.end()
        self._places.append(end)
        try:
            self._root = ast.parse(python, mode="eval").body
            names = (node.id[1:] for node in ast.walk(self._root) if isinstance(node, ast.Name))
            self._names = sorted(set(names))
            tried = self._evaluate(self._root, dict.fromkeys(self._names, np.zeros(0)))
        except SyntaxError as error:
            if "nested" in error.msg:
                raise self._error("it is nested too deeply", 0) from None
            place = self._places[(error.offset or 0) - 1]  # 0 says that the text ends too early
            raise self._error("it is not a condition of this form", place) from None
        except (MemoryError, RecursionError):
            raise self._error("it is nested too deeply", 0) from None
        if tried.dtype != bool:
            raise self._error("it gives a number, not true or false", 0)

    def evaluate(self, arrays: _Values) -> NDArray[np.bool_]:
        """Return which points (n,) meet the condition.

        Raises
        ------
        DimensionError
            If it names a dimension the points do not have.
        """
        values = {name: arrays[_find(name, arrays)] for name in self._names}
        size = len(next(iter(arrays.values()))) if arrays else 0
        return np.broadcast_to(self._evaluate(self._root, values), (size,)).copy()

    def _error(self, what: str, place: int) -> OptionError:
        return OptionError(
            f"the 'where' expression cannot be read: {what}, at character {place + 1}",
            found=repr(self.text),
            cure='Example: "Classification == 2 && Z > 3"',
        )

    def _evaluate(self, node: ast.expr, values: _Values) -> Any:
        """Return the value of a part, truths or numbers; refuse what takes the others."""
        match node:
            case ast.Constant(value=float(number)):
                return np.float64(number)
            case ast.Name(id=word):
                return np.asarray(values[word[1:]], np.float64)
            case ast.BoolOp(op=op, values=nodes):
                parts = nodes
            case ast.UnaryOp(op=ast.Not() | ast.USub() as op, operand=part):
                parts = [part]
            case (
                ast.BinOp(left=left, op=op, right=right)
                | ast.Compare(left=left, ops=[op], comparators=[right])
            ):
                parts = [left, right]
            case _:
                raise self._error(
                    "it is not a condition of this form", self._places[node.col_offset]
                )
        takes_truth = type(op) in _OF_TRUTHS
        operands = [self._evaluate(part, values) for part in parts]
        for part, value in zip(parts, operands, strict=True):
            if (value.dtype == bool) != takes_truth:
                needed = "a condition" if takes_truth else "a number"
                raise self._error(f"{needed} is needed", self._places[part.col_offset])
        function = (_OF_TRUTHS if takes_truth else _OF_NUMBERS)[type(op)]
        with np.errstate(all="ignore"):
            first, *others = operands
            return functools.reduce(function, others, first) if others else function(first)


def _find(name: str, arrays: _Values) -> str:
    """Return the dimension of a name: PDAL takes known ones in any case, and some aliases."""
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
