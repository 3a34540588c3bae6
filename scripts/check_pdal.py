"""Prove that this interpreter has PDAL with a working ``filters.python``; print the versions.

    python scripts/check_pdal.py [--quiet] [--program PDAL] [--driver-path]

Runs a pipeline whose Python step changes three points, which no broken mixture of versions
survives; with ``--program`` also through that ``pdal`` program, which must run this very
interpreter's packages. Exit status 0: it works. 1: it does not, and standard error says why. Needs
nothing but python-pdal. With ``--driver-path`` only print the folder of this interpreter's PDAL
plugins.
"""

from __future__ import annotations

import argparse
import glob
import json
import os
import subprocess
import sys
import sysconfig

SOURCE = """
import sys
import numpy as np

def double(ins, outs):
    if sys.prefix != PREFIX:
        raise RuntimeError(f"filters.python runs the Python of {sys.prefix}, not that of {PREFIX}")
    outs["Z"] = np.ascontiguousarray(ins["Z"] * 2)
    return True
""".replace("PREFIX", repr(sys.prefix))
READER = {
    "type": "readers.faux",
    "mode": "constant",
    "count": 3,
    "bounds": "([1, 2], [1, 2], [21, 22])",
}
PIPELINE = [
    READER,
    {"type": "filters.python", "source": SOURCE, "function": "double", "module": "check_pdal"},
]


def driver_path() -> str | None:
    """Return the folder of this interpreter's PDAL plugins, where pip and conda put them."""
    for key in ("platlib", "purelib"):
        folder = os.path.join(sysconfig.get_path(key), "pdal")
        if glob.glob(os.path.join(folder, "libpdal_plugin_filter_python.*")):
            return folder
    return None


def by_bindings() -> str:
    """Run the pipeline through python-pdal; return what went wrong, if anything."""
    try:
        import pdal
    except Exception as error:
        return f"import pdal: {error}"
    try:
        pipeline = pdal.Pipeline(json.dumps(PIPELINE))
        pipeline.execute()
        heights = pipeline.arrays[0]["Z"].tolist()
    except Exception as error:
        return f"filters.python: {error}"
    return "" if heights == [42.0] * 3 else f"filters.python gave {heights}, not three times 42"


def by_program(program: str) -> str:
    """Run the pipeline through the program; return what went wrong, if anything."""
    command = [program, "pipeline", "--stdin"]
    done = subprocess.run(
        command, input=json.dumps(PIPELINE), text=True, capture_output=True, timeout=120
    )
    return (
        ""
        if done.returncode == 0
        else f"{program}: exit status {done.returncode}: {done.stderr.strip()}"
    )


def main() -> int:
    """Run the checks; return the exit status."""
    parser = argparse.ArgumentParser(description="Prove that PDAL's filters.python works.")
    parser.add_argument("--quiet", action="store_true", help="print no versions")
    parser.add_argument("--program", help="the pdal program, checked as well")
    parser.add_argument(
        "--driver-path", action="store_true", help="only print the folder of the plugins"
    )
    options = parser.parse_args()
    folder = driver_path()
    if options.driver_path:
        print(folder or "")
        return 0
    if folder:
        os.environ.setdefault("PDAL_DRIVER_PATH", folder)
    wrong = by_bindings() or (by_program(options.program) if options.program else "")
    if wrong:
        print(f"{sys.executable}: {wrong}", file=sys.stderr)
        return 1
    if not options.quiet:
        import pdal

        print(
            f"PDAL {pdal.info.version}, python-pdal {pdal.__version__}, Python "
            f"{sys.version.split()[0]}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
