"""PDAL's `where` expressions on NumPy arrays, read by Python's own parser.

PDAL hands a filter with `where` only the points inside; our stages need those outside too, as neighbors, so they evaluate
the expression themselves, with the meaning that PDAL gives it. PDAL's functions (from 2.7 on) are not read.
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
_DEEPEST = 200
_IN_PYTHON = {"&&": "and", "||": "or", "!": "not"}


def _divide(a, b):
    """PDAL's division: by zero it gives NaN, not infinity."""
    return np.where(np.equal(b, 0), np.nan, np.divide(a, b))


#: What takes numbers, and what takes truths.
_OF_NUMBERS: dict[type, Callable] = {
    ast.Eq: np.equal, ast.NotEq: np.not_equal, ast.Lt: np.less, ast.LtE: np.less_equal, ast.Gt: np.greater,
    ast.GtE: np.greater_equal, ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: _divide,
    ast.USub: np.negative,
}  # fmt: skip
_OF_TRUTHS: dict[type, Callable] = {ast.And: np.logical_and, ast.Or: np.logical_or, ast.Not: np.logical_not}
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
    """A parsed `where` expression, such as ``Classification == 2 && Z > 3``.

    Raises
    ------
    OptionError
        If it cannot be parsed; the message points at the place.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        python, self._places = "", list[int]()  # where in the text the characters of the Python come from
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
        self._names: set[str] = set()
        try:
            root = ast.parse(python, mode="eval").body
            if _depth(root) > _DEEPEST:
                raise RecursionError
            truth, self._function = self._compiled(root)
        except SyntaxError as error:
            if "nested" in error.msg:
                raise self._error("it is nested too deeply", 0) from None
            place = self._places[(error.offset or 0) - 1]  # 0: it ends too early
            raise self._error("it is not a condition of this form", place) from None
        except (MemoryError, RecursionError):
            raise self._error("it is nested too deeply", 0) from None
        if not truth:
            raise self._error("it gives a number, not true or false", 0)
        self.dimensions = tuple(sorted(self._names))

    def evaluate(self, arrays: _Values) -> NDArray[np.bool_]:
        """The mask of points for which the expression holds.

        Raises
        ------
        DimensionError
            If it names a dimension the points do not have.
        """
        values = {name: arrays[_find(name, arrays)] for name in self.dimensions}
        size = len(next(iter(arrays.values()))) if arrays else 0
        with np.errstate(all="ignore"):
            return np.broadcast_to(np.asarray(self._function(values), bool), (size,)).copy()

    def _error(self, what: str, place: int) -> OptionError:
        return OptionError(
            f"the 'where' expression cannot be read: {what}, at character {place + 1}",
            found=repr(self.text),
            cure='Example: "Classification == 2 && Z > 3"',
        )

    def _compiled(self, node: ast.expr) -> tuple[bool, Callable[[_Values], Any]]:
        """Whether a part gives true or false, not a number, and what gives it; an error where it does not fit together."""
        match node:
            case ast.Constant(value=float(number)):
                return False, lambda values: number
            case ast.Name(id=word):
                self._names.add(name := word[1:])
                return False, lambda values: np.asarray(values[name], np.float64)
            case ast.BoolOp(op=op, values=parts):
                return True, self._joined(op, *parts)
            case ast.UnaryOp(op=op, operand=part) if type(op) in (ast.Not, ast.USub):
                return isinstance(op, ast.Not), self._joined(op, part)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _OF_NUMBERS:
                return False, self._joined(op, left, right)
            case ast.Compare(left=left, ops=[op], comparators=[right]):
                return True, self._joined(op, left, right)
        raise self._error("it is not a condition of this form", self._places[node.col_offset])

    def _joined(self, op: ast.AST, *nodes: ast.expr) -> Callable[[_Values], Any]:
        """What an operator makes of its parts."""
        takes_truth = type(op) in _OF_TRUTHS
        parts = []
        for node in nodes:
            truth, part = self._compiled(node)
            if truth != takes_truth:
                needed = "a condition" if takes_truth else "a number"
                raise self._error(f"{needed} is needed", self._places[node.col_offset])
            parts.append(part)
        function = (_OF_TRUTHS if takes_truth else _OF_NUMBERS)[type(op)]
        if len(parts) == 1:
            return lambda values: function(parts[0](values))
        return lambda values: functools.reduce(function, (part(values) for part in parts))


def _depth(node: ast.AST) -> int:
    return 1 + max(map(_depth, ast.iter_child_nodes(node)), default=0)


def _find(name: str, arrays: _Values) -> str:
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
