"""What a release consists of: one version, a recipe that asks for the same, a wheel with all that it needs."""

from __future__ import annotations

import re
import sys
import zipfile
from pathlib import Path

import pytest
from processes import ended, printed, python

from pdal_stages.base.version import __version__

ROOT = Path(__file__).resolve().parent.parent
PYPROJECT = (ROOT / "pyproject.toml").read_text()
#: Names on PyPI that conda-forge has otherwise.
_CONDA = {"laspy[lazrs]": "laspy"}


def test_one_version_everywhere():
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f'\n  version: "{__version__}"\n' in (ROOT / "recipe" / "recipe.yaml").read_text()
    assert (
        f'\n  version: "{__version__}"\n'
        in (ROOT / "recipe" / "plugin" / "recipe.yaml").read_text()
    )
    assert (
        f"\nversion={__version__}\n" in (ROOT / "qgis" / "pdal_stages" / "metadata.txt").read_text()
    )
    assert f"\n## [{__version__}] - " in (ROOT / "CHANGELOG.md").read_text()


@pytest.mark.parametrize("file", ["recipe/recipe.yaml", "environment.yml"])
def test_conda_asks_for_what_pip_asks_for(file):
    block = re.search(r"\ndependencies = \[\n(.*?)\n\]", PYPROJECT, re.DOTALL)
    wanted = re.findall(r'"([^">]+)>=([^"]+)"', block[1])
    text = (ROOT / file).read_text()
    assert len(wanted) >= 8
    for name, bound in wanted:
        assert f"- {_CONDA.get(name, name)} >={bound}\n" in text, name


@pytest.mark.slow
def test_a_wheel_has_all_that_it_needs(tmp_path):
    """Built from a copy, installed into a clean environment whose packages are this one's."""
    source = tmp_path / "source"
    listed = printed("git", "-C", ROOT, "ls-files", "-z").split("\0")
    for name in filter(None, listed):
        if name.startswith("pdal_stages/") or "/" not in name:
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    wheels = tmp_path / "wheels"
    built = ended(sys.executable, "-m", "pip", "wheel", "--no-deps", "-q", "-w", wheels, source)
    if built.returncode and re.search("No matching distribution|connection", built.stderr):
        pytest.skip("pip's index has no setuptools to build with")
    assert built.returncode == 0, built.stderr
    (wheel,) = wheels.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    here = {path.relative_to(ROOT).as_posix() for path in (ROOT / "pdal_stages").rglob("*.py")}
    assert here - {name for name in here if name not in listed} <= names
    for needed in (
        "models/standard.model",
        "reports/templates/style.css",
        "plugin/stage.cpp",
        "py.typed",
    ):
        assert f"pdal_stages/{needed}" in names, needed
    target = tmp_path / "env"
    zipfile.ZipFile(wheel).extractall(target)
    code = (
        "import pdal_stages, pdal_stages.plugin.install as install\n"
        "from pdal_stages.classifier.model import loaded_model\n"
        "print(pdal_stages.__file__, install.SOURCE, len(loaded_model('standard').classes))"
    )
    package, sources, classes = python(code, env={"PYTHONPATH": str(target)}, cwd=tmp_path).split()
    assert package.startswith(str(target)) and sources.startswith(str(target)) and int(classes) >= 2
