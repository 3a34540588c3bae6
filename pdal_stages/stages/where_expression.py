"""Conditions of the option `where`, such as ``Classification == 2 && Z > 3``.

PDAL hands a filter with `where` only the points inside; our stages need those outside too, as
neighbors, so they evaluate the condition themselves, with the meaning that PDAL gives it. Functions
(PDAL 2.7 and later) are not read.
"""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import DimensionError, OptionError, suggest
from ..base.messages import shorten

_TOKEN = re.compile(
    r"(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<mark>&&|\|\||==|!=|<=|>=|[-+*/()<>!])|(?P<other>\S)",
    re.ASCII,
)
#: PDAL's operator -> Python's.
_IN_PYTHON = {"&&": "and", "||": "or", "!": "not"}


def _divide(a, b):
    """Divide as PDAL does: by zero it gives NaN, not infinity."""
    return np.where(np.equal(b, 0), np.nan, np.divide(a, b))


#: Function of an operator, and whether it takes truth values.
_OPERATORS: dict[type, tuple[Callable, bool]] = {
    ast.Eq: (np.equal, False),
    ast.NotEq: (np.not_equal, False),
    ast.Lt: (np.less, False),
    ast.LtE: (np.less_equal, False),
    ast.Gt: (np.greater, False),
    ast.GtE: (np.greater_equal, False),
    ast.Add: (np.add, False),
    ast.Sub: (np.subtract, False),
    ast.Mult: (np.multiply, False),
    ast.Div: (_divide, False),
    ast.USub: (np.negative, False),
    ast.And: (np.logical_and, True),
    ast.Or: (np.logical_or, True),
    ast.Not: (np.logical_not, True),
}
_Values = Mapping[str, NDArray]


class Expression:
    """A `where` expression, such as ``Classification == 2 && Z > 3``, read by Python's own parser.

    Raises
    ------
    OptionError
        If it cannot be read.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        python = " ".join(map(self._in_python, _TOKEN.finditer(text)))
        try:
            self._root = ast.parse(python, mode="eval").body
            names = (node.id[1:] for node in ast.walk(self._root) if isinstance(node, ast.Name))
            self.names = sorted(set(names))  #: of dimensions, in any case
            tried = self._evaluate(self._root, dict.fromkeys(self.names, np.zeros(0)))
        except SyntaxError:
            raise self._error("it is not a condition of this form") from None
        except (MemoryError, RecursionError):
            raise self._error("it is nested too deeply") from None
        if tried.dtype != bool:
            raise self._error("it gives a number, not true or false")

    def _in_python(self, token: re.Match[str]) -> str:
        """Return a number, name or operator as Python writes it."""
        kind = str(token.lastgroup)
        if kind == "other":
            raise self._error(f"'{token[0]}' is not understood, at character {token.start() + 1}")
        if kind == "number":
            return repr(float(token[0])).replace("inf", "1e999")
        # Some names are words of Python.
        return f"_{token[0]}" if kind == "name" else _IN_PYTHON.get(token[0], token[0])

    def check(self, names: Collection[str]) -> None:
        """Refuse names that are not among those of dimensions; errors as of :meth:`evaluate`."""
        for name in self.names:
            _find(name, names)

    def evaluate(self, arrays: _Values) -> NDArray[np.bool_]:
        """Return which points (n,) meet the condition.

        Raises
        ------
        DimensionError
            If it names a dimension the points do not have.
        """
        values = {name: arrays[_find(name, arrays)] for name in self.names}
        size = len(next(iter(arrays.values()))) if arrays else 0
        return np.broadcast_to(self._evaluate(self._root, values), (size,)).copy()

    def _error(self, what: str) -> OptionError:
        return OptionError(
            f"the 'where' expression cannot be read: {what}",
            found=repr(shorten(self.text)),
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
            case ast.UnaryOp(op=op, operand=part):
                parts = [part]
            case (
                ast.BinOp(left=left, op=op, right=right)
                | ast.Compare(left=left, ops=[op], comparators=[right])
            ):
                parts = [left, right]
            case _:
                raise self._error("it is not a condition of this form")
        function, takes_truths = _OPERATORS.get(type(op), (None, False))
        first, *others = [self._evaluate(part, values) for part in parts]
        if function is None:
            raise self._error("it is not a condition of this form")
        if any((value.dtype == bool) != takes_truths for value in (first, *others)):
            raise self._error(f"{'a condition' if takes_truths else 'a number'} is needed")
        with np.errstate(all="ignore"):
            return functools.reduce(function, others, first) if others else function(first)


def _find(name: str, arrays: Collection[str]) -> str:
    """Return the dimension of a name, which PDAL takes in any case."""
    for known in (name, *arrays):
        if known.lower() == name.lower() and known in arrays:
            return known
    raise DimensionError(
        f"'where' names the dimension '{name}', which the points do not have",
        found=", ".join(arrays),
        cure=suggest(name, arrays) or None,
    )
