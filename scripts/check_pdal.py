"""Prove that this interpreter has PDAL with a working ``filters.python``; print the versions.

    python scripts/check_pdal.py [--quiet | --driver-path]

Runs a pipeline whose Python step changes three points, which no broken mixture of versions survives. Exit
status 0: it works. 1: it does not, and standard error says why. Needs nothing but python-pdal. With
``--driver-path`` only print the folder of this interpreter's PDAL plugins.
"""

from __future__ import annotations

import glob
import json
import os
import sys
import sysconfig

SOURCE = """
import numpy as np

def double(ins, outs):
    outs["Z"] = np.ascontiguousarray(ins["Z"] * 2)
    return True
"""
PIPELINE = [
    {"type": "readers.faux", "mode": "constant", "count": 3, "bounds": "([1, 2], [1, 2], [21, 22])"},
    {"type": "filters.python", "source": SOURCE, "function": "double", "module": "check_pdal"},
]


def driver_path() -> str | None:
    """Return the folder of this interpreter's PDAL plugins, where pip and conda put them."""
    for key in ("platlib", "purelib"):
        folder = os.path.join(sysconfig.get_path(key), "pdal")
        if glob.glob(os.path.join(folder, "libpdal_plugin_filter_python.*")):
            return folder
    return None


def main() -> int:
    """Run the pipeline; return the exit status."""
    folder = driver_path()
    if "--driver-path" in sys.argv:
        print(folder or "")
        return 0
    if folder:
        os.environ.setdefault("PDAL_DRIVER_PATH", folder)
    try:
        import pdal
    except Exception as error:
        print(f"{sys.executable}: import pdal: {error}", file=sys.stderr)
        return 1
    try:
        pipeline = pdal.Pipeline(json.dumps(PIPELINE))
        pipeline.execute()
        heights = pipeline.arrays[0]["Z"].tolist()
    except Exception as error:
        print(f"{sys.executable}: filters.python: {error}", file=sys.stderr)
        return 1
    if heights != [42.0] * 3:
        print(f"{sys.executable}: filters.python gave {heights}, not three times 42", file=sys.stderr)
        return 1
    if "--quiet" not in sys.argv:
        print(f"PDAL {pdal.info.version}, python-pdal {pdal.__version__}, Python {sys.version.split()[0]}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
