"""What a stranger needs in order to read the package: short functions, named constants, short lines."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

#: The rooms of the package.
ROOMS = (
    "accuracy", "alsnet", "base", "classifier", "cli", "features", "objects", "pipeline", "plugin",
    "reports", "review", "stages", "structures", "synthetic", "terrain", "tiling",
)  # fmt: skip

MODULES = [
    *sorted(path for room in ROOMS for path in (ROOT / "pdal_stages" / room).rglob("*.py")),
    *sorted((ROOT / "qgis" / "pdal_stages").glob("*.py")),
]

MOST_LINES = 60
MOST_PARAMETERS = 8


def functions(tree: ast.Module) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    arguments = function.args
    every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    return [argument.arg for argument in every]


def complaints(path: Path) -> Iterator[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple):
            yield f"{node.lineno}: several constants under one comment: one a line, each with its reason"
    for function in functions(tree):
        length = (function.end_lineno or 0) - function.lineno
        count = len(parameters(function))
        if length > MOST_LINES or count > MOST_PARAMETERS:
            yield f"{function.lineno}: {function.name} has {length} lines and {count} parameters"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_module_can_be_read(path):
    assert list(complaints(path)) == []


@pytest.mark.parametrize(
    "page",
    [
        *sorted(ROOT.glob("*.md")),
        *sorted(set((ROOT / "docs").glob("*.md")) - {ROOT / "docs" / "models.md"}),
    ],  # card.py's
    ids=lambda page: page.name,
)
def test_lines_of_a_page_fit_the_screen(page):
    lines = page.read_text(encoding="utf-8").splitlines()
    assert [(n, len(line)) for n, line in enumerate(lines, 1) if len(line) > 120] == []
