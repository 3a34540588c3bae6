"""Patch the sources of python-pdal and pdal-plugins before they are compiled.

    python patch_bindings.py PDAL_SOURCES PLUGINS_SOURCES PDAL_PROGRAM [PLUGIN_FOLDER]

Each patch says how often it must apply, so another release of the sources is refused, not half
patched. Called by scripts/install-pdal, which chooses the releases.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path


def substitute(file: Path, pattern: str, replacement: str, times: int) -> None:
    """Replace ``pattern`` in ``file``; stop unless it is found exactly ``times`` times."""
    text, count = re.subn(
        pattern, replacement, file.read_text(encoding="utf-8"), flags=re.MULTILINE
    )
    if count != times:
        raise SystemExit(
            f"{file}: {pattern!r} found {count} times, not {times}: not the expected release"
        )
    file.write_text(text, encoding="utf-8")


def numpy_2(bindings: Path, plugins: Path) -> None:
    """Let python-pdal 3.1 and pdal-plugins 1.0 compile with NumPy 2, whose array descriptor is
    opaque.

    Compiled so, they run with NumPy 1 and 2. Later releases have this.
    """
    substitute(bindings / "pdal/PyArray.cpp", r"\bdtype->fields\b", "PyDataType_FIELDS(dtype)", 3)
    executor = bindings / "pdal/StreamableExecutor.cpp"
    substitute(executor, r", PyArray_GETPTR1\(", ", (char *)PyArray_GETPTR1(", 2)
    reader = plugins / "pdal/io/NumpyReader.cpp"
    substitute(reader, r"\bm_dtype->fields\b", "PyDataType_FIELDS(m_dtype)", 3)
    substitute(reader, r"\bdt->elsize\b", "PyDataType_ELSIZE(dt)", 1)
    substitute(
        plugins / "pdal/plang/Invocation.cpp", r"\bdtype->elsize\b", "PyDataType_ELSIZE(dtype)", 2
    )


#: In the place of `class Stage` and of the names of stages that PDAL has.
_TYPES = """\
class _Types(type):
    # PDAL's own stages as attributes (Reader.las), asked for when the first of them is named
    def __getattr__(cls, name):
        if name.startswith("_") or "StreamableTypes" in vars(drivers):
            raise AttributeError(f"type object {cls.__name__!r} has no attribute {name!r}")
        drivers.inject_pdal_drivers()
        return getattr(cls, name)

    def __dir__(cls):
        drivers.StreamableTypes
        return super().__dir__()


class Stage(metaclass=_Types):
"""
_STREAMABLE = """\


def __getattr__(name: str) -> FrozenSet:
    if name != "StreamableTypes":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    inject_pdal_drivers()
    return StreamableTypes


def inject_pdal_drivers() -> None:
"""


def one_program(bindings: Path, program: str) -> None:
    """Let python-pdal 3.1 ask the PDAL it was compiled for, whatever PATH says, once, and only for
    what needs it.

    It learns the drivers by running ``pdal --drivers`` and ``pdal --options``, the second one
    twice, whenever it is imported: a tenth of a second, and pipelines given as JSON need none of
    it.
    """
    drivers = bindings / "pdal/drivers.py"
    second = r"^    command = 'pdal --options all --showjson'\n(?:.*\n)*?    options = dict\(.*\)\n"
    substitute(drivers, second, "", 1)
    substitute(drivers, r'\["pdal", ', f"[{program!r}, ".replace("\\", r"\\"), 2)
    substitute(drivers, r"\n\ndef inject_pdal_drivers\(\) -> None:\n", _STREAMABLE, 1)
    substitute(bindings / "pdal/__init__.py", r"^inject_pdal_drivers\(\)\n", "", 1)
    substitute(bindings / "pdal/pipeline.py", r"^class Stage:\n", _TYPES, 1)


def plugin_folder(bindings: Path, source: str, folder: str) -> None:
    """Let ``import pdal`` find the plugins that lie beside it, where PDAL_DRIVER_PATH is not set.

    Set, the variable replaces PDAL's own search, so the folder of PDAL's compiled plugins is added.
    """
    init = bindings / source / "__init__.py"
    value = (
        f"_os.path.dirname(__file__) + {':' + folder!r}" if folder else "_os.path.dirname(__file__)"
    )
    text = f'import os as _os\n\n_os.environ.setdefault("PDAL_DRIVER_PATH", {value})\n'
    init.write_text(text + init.read_text(encoding="utf-8"), encoding="utf-8")


def exception_references(plugins: Path, source: str) -> None:
    """Mend a crash when the interpreter ends after a Python step raised.

    PyTuple_SetItem takes over the references to the exception, which are released once more further
    down.
    """
    substitute(
        plugins / source / "plang/Environment.cpp",
        r"^ *PyTuple_SetItem\(args, 2, traceback\);",
        r"\g<0>\n        Py_INCREF(type); Py_INCREF(value); Py_INCREF(traceback);",
        1,
    )


def main(bindings: str, plugins: str, program: str, folder: str = "") -> None:
    """Apply what the releases at hand need."""
    source = "src/pdal" if Path(bindings, "src").is_dir() else "pdal"
    if source == "pdal":
        numpy_2(Path(bindings), Path(plugins))
        one_program(Path(bindings), program)
    plugin_folder(Path(bindings), source, folder)
    exception_references(Path(plugins), source)


if __name__ == "__main__":
    main(*sys.argv[1:])
