"""The program ``pdal-stages``: where it is, how it is run, what it can do. No QGIS here."""

import glob
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

#: Of the JSON of `pdal-stages commands --showjson`.
FORMAT = 1
OLDEST = "0.2.0"
INSTALL = (
    "Install pdal-stages into an environment of its own (conda create -n pdal-stages -c "
    "conda-forge python-pdal; pip install 'pdal-stages[vector]' in it), then name its program: "
    "Settings > Options > Processing > Providers > pdal-stages"
)
_WINDOWS = sys.platform == "win32"
_NAME = "pdal-stages.exe" if _WINDOWS else "pdal-stages"
#: Variables that QGIS sets for its own Python, GDAL and PROJ, which another environment must not
#: see.
_OF_QGIS = (
    "PYTHONHOME", "PYTHONPATH", "PYTHONEXECUTABLE", "VIRTUAL_ENV", "GDAL_DATA",
    "GDAL_DRIVER_PATH", "PROJ_LIB", "PROJ_DATA",
)  # fmt: skip

#: Folders of conda's kind in the user's own.
_CONDA = (
    "miniforge3",
    "mambaforge",
    "miniconda3",
    "anaconda3",
    "micromamba",
    ".conda",
    ".virtualenvs",
)


class Missing(Exception):
    """Raised where the program is missing or does not work; the text says what to do."""


def find(setting=""):
    """Return the program: the setting, ``PDAL_STAGES_PROGRAM``, PATH, conda, pip, pipx.

    Raises
    ------
    Missing
        With all places that were looked at.
    """
    named = (setting or os.environ.get("PDAL_STAGES_PROGRAM", "")).strip()
    if named:
        path = Path(named).expanduser()
        for file in (path, path / _folder() / _NAME, path / _NAME):
            if file.is_file() and os.access(file, os.X_OK):
                return str(file)
        raise Missing(f"There is no program pdal-stages at {named}. {INSTALL}.")
    on_path = shutil.which("pdal-stages")
    if on_path:
        return on_path
    for folder in environments():
        file = Path(folder, _folder(), _NAME)
        if file.is_file() and os.access(file, os.X_OK):
            return str(file)
    raise Missing(
        f"The program pdal-stages was not found on PATH or in an environment of conda. {INSTALL}."
    )


def _folder():
    return "Scripts" if _WINDOWS else "bin"


def environments():
    """Return folders of environments that may hold the program, the likeliest first."""
    home = Path.home()
    known = home / ".conda" / "environments.txt"
    listed = known.read_text(errors="replace").splitlines() if known.is_file() else []
    usual = []
    for root in _CONDA:
        usual += [*sorted(glob.glob(str(home / root / "envs" / "*"))), str(home / root)]
    usual += [
        str(home / ".local" / "share" / "pipx" / "venvs" / "pdal-stages"),
        str(home / ".local"),
    ]
    usual += [str(home / name / ".venv") for name in ("pdal-stages", "pdal_stages")]
    every = dict.fromkeys([*listed, *usual])
    return sorted(every, key=lambda folder: "pdal" not in Path(folder).name.lower())


def variables(program):
    """Return environment variables to run the program as if its environment were active."""
    out = {name: value for name, value in os.environ.items() if name not in _OF_QGIS}
    folder = Path(program).parent
    prefix = folder.parent
    first = [str(folder)]
    if (prefix / "conda-meta").is_dir():
        out["CONDA_PREFIX"] = str(prefix)
        if _WINDOWS:
            first += [str(prefix), str(prefix / "Library" / "bin")]
            out["GDAL_DATA"] = str(prefix / "Library" / "share" / "gdal")
            out["PROJ_DATA"] = str(prefix / "Library" / "share" / "proj")
    out["PATH"] = os.pathsep.join([*first, out.get("PATH", "")])
    out["PYTHONUNBUFFERED"] = "1"
    out["PYTHONIOENCODING"] = "utf-8"
    out["PDAL_STAGES_PROGRESS"] = "lines"
    return out


def without_window():
    """Return arguments of subprocess that keep Windows from opening a console."""
    return (
        {"creationflags": subprocess.CREATE_NO_WINDOW | subprocess.CREATE_NEW_PROCESS_GROUP}
        if _WINDOWS
        else {}
    )


def ask(program, *arguments, timeout=120):
    """Return what the program prints, or raise :class:`Missing` where it fails."""
    try:
        done = subprocess.run(
            [program, *arguments],
            env=variables(program),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=timeout,
            **without_window(),
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise Missing(f"{program} cannot be run: {error}. {INSTALL}.") from None
    if done.returncode:
        reason = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise Missing(
            f"{program} {' '.join(arguments)} failed: {''.join(reason)} (it must be {OLDEST} or "
            f"newer). {INSTALL}."
        )
    return done.stdout.decode("utf-8", errors="replace")


def forms(program, cache):
    """Return the arguments of commands and stages, cached in a folder per installation."""
    status = os.stat(program)
    root = Path(program).resolve().parent.parent
    # An upgrade in place leaves the program as it is, and changes the folder of packages
    sites = [*root.glob("lib/python3*/site-packages"), *root.glob("Lib/site-packages")]
    key = [
        FORMAT,
        str(program),
        status.st_mtime,
        status.st_size,
        *[site.stat().st_mtime for site in sites],
    ]
    kept = Path(cache, "commands.json")
    try:
        held = json.loads(kept.read_text(encoding="utf-8"))
        if held["key"] == key:
            return held["forms"]
    except (OSError, ValueError, KeyError, TypeError):
        pass
    answer = checked(ask(program, "commands", "--showjson"), program)
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        part = kept.with_suffix(f".{os.getpid()}")
        part.write_text(json.dumps({"key": key, "forms": answer}), encoding="utf-8")
        part.replace(kept)
    except OSError:
        pass  # asked again the next time
    return answer


def checked(text, program):
    """Return the parsed JSON, or raise :class:`Missing` where its form is not known."""
    try:
        answer = json.loads(text)
        if answer["format"] == FORMAT:
            return answer
        reason = (
            f"the form {answer['format']} of its commands is not known here: update the plugin or "
            "pdal-stages"
        )
    except (ValueError, KeyError, TypeError):
        reason = "what it says about its commands cannot be read"
    raise Missing(f"{program}: {reason}.")


def shipped():
    """Return the arguments at the time the plugin was packed; None in a checkout."""
    path = Path(__file__).with_name("commands.json")
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
