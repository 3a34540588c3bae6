"""The house: imports go down only, and private names stay in their room."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent / "pdal_stages"
FLOORS = (
    "base", "features terrain accuracy", "structures classifier", "alsnet objects", "reports", "stages", "pipeline",
    "synthetic tiling plugin review", "surfaces", "cli",
)  # fmt: skip
#: Rooms that the core works without, and the modules of the core that may import them.
EXTRAS = {"objects", "review", "reports", "surfaces", "synthetic"}
DOORS = {
    "stages/accuracy.py", "stages/group_objects.py", "stages/write_objects.py",
    "tiling/objects_from_files.py", "cli/deliverables.py", "cli/extras.py", "cli/installation.py",
}  # fmt: skip
FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms.split()}


@pytest.mark.parametrize(
    "path", sorted(ROOT.rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT))
)
def test_house(path):
    parts, *rest = path.relative_to(ROOT).with_suffix("").parts
    for node in ast.walk(ast.parse(path.read_text())) if parts != "__init__" else ():
        if not isinstance(node, ast.ImportFrom) or not node.level:
            continue
        module = (*[parts, *rest][: -node.level], *(node.module or "").split("."))
        for room in [module[0]] if module[0] else [alias.name for alias in node.names]:
            assert room == parts or FLOOR[room] < FLOOR[parts], (
                f"line {node.lineno}: {parts} imports {room}"
            )
            private = [
                imported.name
                for imported in node.names
                if imported.name.startswith("_") and imported.name != "__version__"
            ]
            assert room == parts or not private, f"line {node.lineno}: {private} of {room}"


def test_the_core_imports_extras_in_their_doors_alone():
    importing = set()
    for path in sorted(ROOT.rglob("*.py")):
        name, room = str(path.relative_to(ROOT)), path.relative_to(ROOT).parts[0]
        if room in EXTRAS or room == "__init__.py":
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            module = (node.module or "").split(".")[0] if isinstance(node, ast.ImportFrom) else ""
            if module in EXTRAS and node.level == 2:
                importing.add(name)
    assert importing == DOORS


@pytest.mark.parametrize(
    "path", sorted(ROOT.rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT))
)
def test_no_import_upward_by_name(path):
    """No string names a module of the same floor or above, as ``pkgutil.resolve_name`` would take it."""
    room = path.relative_to(ROOT).parts[0]
    tree = ast.parse(path.read_text())
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, documented) and node.body and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree) if room in FLOOR else ():
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            for other in re.findall(r"\bpdal_stages\.(\w+)", node.value):
                assert (
                    id(node) in docstrings or other == room or FLOOR.get(other, -1) < FLOOR[room]
                ), f"line {node.lineno}: {room} names {other}"


def imported_modules(path: Path) -> set[str]:
    """Return the modules of the package that one imports, anywhere in it and for types alone."""
    package = path.relative_to(ROOT.parent).parts[:-1]
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            above = package[: len(package) - node.level + 1]
            module = ".".join([*above, *([node.module] if node.module else [])])
            names |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
    return names


def test_no_circle_of_modules():
    """No module needs another that needs it; packages, which only name what is in them, aside."""
    paths = [path for path in ROOT.rglob("*.py") if path.name != "__init__.py"]
    named = {".".join(p.relative_to(ROOT.parent).with_suffix("").parts): p for p in paths}
    needed = {name: imported_modules(path) & named.keys() - {name} for name, path in named.items()}
    while free := {name for name, names in needed.items() if not names & needed.keys()}:
        needed = {name: names for name, names in needed.items() if name not in free}
    assert not needed


def test_one_class_one_name():
    """No two public classes of the package have one name, so that a name means one thing in any room."""
    doors: dict[str, str] = {}
    for path in sorted(ROOT.rglob("*.py")):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                module = str(path.relative_to(ROOT))
                assert doors.setdefault(node.name, module) == module, (
                    f"{node.name} in {doors[node.name]} and {module}"
                )
