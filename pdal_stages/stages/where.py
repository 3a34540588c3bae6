"""PDAL's `where` expressions on NumPy arrays, read by Python's own parser.

PDAL hands a filter with `where` only the points inside; our stages need those outside too, as neighbors, so they evaluate
the expression themselves. What any PDAL from 2.2 to 2.10 takes is taken here with the same meaning.
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


def _round(a):
    """C's rounding, halves away from zero."""
    whole = np.trunc(a)
    return np.where(np.abs(a - whole) >= 0.5, whole + np.sign(a), whole)


_COMPARISONS: dict[type, Callable] = {
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
}
_ARITHMETIC: dict[type, Callable] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: _divide,
}
_LIMITS = np.finfo(np.float64)
_CONSTANTS: dict[str, Callable] = {
    "nan": lambda: np.nan,
    "lowest": lambda: float(_LIMITS.min),
    "highest": lambda: float(_LIMITS.max),
}
_CONDITIONS: dict[str, Callable] = {
    "isnan": np.isnan,
    "ismin": lambda a: np.equal(a, _LIMITS.min),
    "ismax": lambda a: np.equal(a, _LIMITS.max),
}
_FUNCTIONS: dict[str, Callable] = {
    **{name: getattr(np, name) for name in ("abs", "fabs", "floor", "ceil", "sqrt", "exp", "exp2")},
    **{
        name: getattr(np, name)
        for name in ("log", "log2", "log10", "sin", "cos", "tan", "sinh", "cosh", "tanh")
    },
    **{name: getattr(np, f"arc{name[1:]}") for name in ("asin", "acos", "atan", "asinh", "acosh")},
    "round": _round,
}
_CALLED = _FUNCTIONS | _CONDITIONS | _CONSTANTS
#: Other names that PDAL takes for dimensions, in small letters.
_ALIASES = {
    "class": "Classification",
    "cls": "Classification",
    "hag": "HeightAboveGround",
    "nearinfrared": "Infrared",
    "scanangle": "ScanAngleRank",
}


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
            self._root = ast.parse(python, mode="eval").body
            if _depth(self._root) > _DEEPEST:
                raise RecursionError
            truth = self._is_truth(self._root)
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

    def _is_truth(self, node: ast.expr) -> bool:
        """Whether a part gives true or false, not a number; an error where it does not fit together."""
        match node:
            case ast.Constant():
                return False
            case ast.Name(id=name):
                self._names.add(name[1:])
                return False
            case ast.BoolOp(values=parts):
                return self._needs(True, *parts)
            case ast.UnaryOp(op=ast.Not(), operand=part):
                return self._needs(True, part)
            case ast.UnaryOp(op=ast.USub(), operand=part):
                return self._needs(False, part)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _ARITHMETIC:
                return self._needs(False, left, right)
            case ast.Compare(left=left, comparators=[right]):
                return not self._needs(False, left, right)
            case ast.Call(func=ast.Name(id=word), args=parts):
                name = word[1:]
                if len(parts) == (0 if name in _CONSTANTS else 1) and name in _CALLED:
                    self._needs(False, *parts)
                    return name in _CONDITIONS
                raise self._error(
                    f"'{name}' is not a function; known are {', '.join(_CALLED)}", self._at(node)
                )
        raise self._error("it is not a condition of this form", self._at(node))

    def _needs(self, truth: bool, *parts: ast.expr) -> bool:
        for part in parts:
            if self._is_truth(part) != truth:
                raise self._error(f"{'a condition' if truth else 'a number'} is needed", self._at(part))
        return truth

    def _at(self, node: ast.expr) -> int:
        return self._places[node.col_offset]


def _depth(node: ast.AST) -> int:
    return 1 + max(map(_depth, ast.iter_child_nodes(node)), default=0)


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


def _value(node: ast.expr, arrays: Mapping[str, NDArray]) -> Any:
    match node:
        case ast.Constant(value=float(number)):
            return number
        case ast.Name(id=name):
            return np.asarray(arrays[name[1:]], np.float64)
        case ast.BoolOp(op=op, values=parts):
            join = np.logical_and if isinstance(op, ast.And) else np.logical_or
            return functools.reduce(join, (_value(part, arrays) for part in parts))
        case ast.UnaryOp(op=op, operand=part):
            return (np.logical_not if isinstance(op, ast.Not) else np.negative)(_value(part, arrays))
        case ast.BinOp(left=left, op=op, right=right):
            return _ARITHMETIC[type(op)](_value(left, arrays), _value(right, arrays))
        case ast.Compare(left=left, ops=[op], comparators=[right]):
            return _COMPARISONS[type(op)](_value(left, arrays), _value(right, arrays))
        case ast.Call(func=ast.Name(id=name), args=parts):
            called = _CALLED[name[1:]]
            return called(*(_value(part, arrays) for part in parts))
    raise AssertionError(node)
