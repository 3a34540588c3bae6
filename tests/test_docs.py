"""What the docs show is run: JSON parses and lowers, snippets run, the worked example is a stage that works."""

from __future__ import annotations

import functools
import importlib
import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest
from jsonschema import Draft202012Validator

import pdal_stages as ps
from pdal_stages.stages.registry import stage_types

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    return blocks_of(page.read_text(encoding="utf-8"), language)


def test_names_of_the_api_page_are_there():
    """In their modules, and in the package itself, as the page says."""
    names = re.findall(
        r"^\.\. auto\w+:: (\S+)\.(\w+)$", (ROOT / "docs" / "api.md").read_text(), re.MULTILINE
    )
    assert names and all(hasattr(importlib.import_module(module), name) for module, name in names)
    assert [name for _, name in names if not hasattr(ps, name)] == []


def test_tests_that_the_docs_name_are_there():
    """A page promises what a test shows: every row of such a table names one."""
    named = 0
    for page in ("robustness", "security"):
        text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
        rows = [line for line in text.splitlines() if line.startswith("| ")]
        for row in rows:
            tests = re.findall(r"`([\w/]+\.py)(?:::(\w+))?`", row)
            named += len(tests)
            assert tests or row.endswith("| tests in `tests/` |"), row
            for file, function in tests:
                assert f"def {function or 'test_'}" in (ROOT / "tests" / file).read_text(
                    encoding="utf-8"
                ), row
    assert named > 20


def stages_in(text: str) -> list[dict]:
    """Return the stages of a JSON block: a pipeline, a list of stages or one stage."""
    value = json.loads(text)
    if isinstance(value, dict):
        value = value.get("pipeline", [value] if "type" in value else [])
    return [stage for stage in value if isinstance(stage, dict)]


def test_options_of_stages_in_the_docs_are_declared():
    """A model file that an example names is not here, so the schema decides, not a run."""
    examples = [
        (page.name, stage)
        for page in PAGES
        for text in blocks(page, "json")
        for stage in stages_in(text)
        if stage["type"] in stage_types()
    ]
    for page, stage in examples:
        errors = Draft202012Validator(stage_types()[stage["type"]].schema()).iter_errors(stage)
        assert [error.message for error in errors] == [], page
    assert {stage["type"] for _, stage in examples} >= {
        "filters.hag_morphological", "filters.modelclassifier", "writers.classifiermodel",
    }  # fmt: skip


def test_numpy_snippet_runs(tmp_path, monkeypatch, write_las, capsys, random_cloud):
    monkeypatch.chdir(tmp_path)
    xyz = random_cloud(500)
    write_las(
        tmp_path / "raw.laz", {"X": xyz[:, 0], "Y": xyz[:, 1], "Z": xyz[:, 2]}, point_format=3
    )
    (snippet,) = blocks(ROOT / "docs" / "api.md", "python")
    exec(compile(snippet, "api.md", "exec"), {})
    assert "Linearity_c1" in capsys.readouterr().out


@pytest.mark.pdal
def test_the_readme_shows_the_height_that_the_project_began_with(
    tmp_path, monkeypatch, write_las, pdal_module
):
    """filters.hag_minima [W18], in a pipeline of one line, which runs as printed."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    arrays = dict(zip("XYZ", rng.uniform(0, 60, (3, 2000)), strict=True))
    write_las("raw.laz", arrays, point_format=6)
    (line,) = [text for text in blocks(ROOT / "README.md", "json") if "hag_minima" in text]
    assert len(line.splitlines()) == 1
    ps.run_pipeline(json.loads(line))
    expected = ps.hag_minima(*laspy.read("raw.laz").xyz.T)
    assert np.allclose(laspy.read("heights.laz").HeightAboveGround, expected, atol=1e-4)


@pytest.mark.pdal
def test_pipelines_and_python_objects_run(tmp_path, monkeypatch, write_las, pdal_module):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 30, (2, 1500))
    block = (x > 15) & (y > 15)
    labels = np.where(block, 6, np.where(x < 8, 4, 2)).astype(np.uint8)
    z = np.where(block, 5.0, np.where(x < 8, rng.uniform(0, 4, 1500), 0.0)) + rng.normal(
        0, 0.02, 1500
    )
    for name in ("labeled.laz", "raw.laz"):
        write_las(
            tmp_path / name, {"X": x, "Y": y, "Z": z, "Classification": labels}, point_format=3
        )
    page = ROOT / "docs" / "pipelines.md"
    train, classify = blocks(page, "json")
    ps.run_pipeline(train)
    assert ps.run_pipeline(classify).arrays
    (tmp_path / "classified.laz").unlink()
    names: dict = {}
    for snippet in blocks(page, "python"):
        exec(compile(snippet, "pipelines.md", "exec"), names)
    assert (tmp_path / "classified.laz").stat().st_size > 1000
    assert (tmp_path / "heights.laz").stat().st_size > 1000


@pytest.mark.parametrize("stage", stage_types().values(), ids=lambda stage: stage.type)
def test_the_page_of_a_stage_shows_an_example_that_its_schema_takes(stage, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    import stage_pages

    (shown, *_) = blocks_of(stage_pages.page(stage), "json")
    (example,) = [s for s in stages_in(shown) if s["type"] == stage.type]
    schema = stage.schema()
    Draft202012Validator.check_schema(schema)
    validator = Draft202012Validator(schema)
    assert validator.is_valid(example)
    assert not validator.is_valid({**example, "nonsense": 1})
    for required in schema["required"]:
        assert not validator.is_valid({k: v for k, v in example.items() if k != required})


def blocks_of(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """Return the names by which links reach the headings of a page."""
    text = re.sub(
        r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
    )
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading) for heading in headings)
    return {re.sub(r"[^\w\- ]", "", each.lower()).strip().replace(" ", "-") for each in plain}


def test_links_lead_somewhere_in_a_clone():
    """Files that are generated when the pages are built are not there; headings are checked, too."""
    tracked = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True)
    pages = [ROOT / name for name in tracked.stdout.split() if (ROOT / name).exists()] or PAGES
    generated = ROOT / "docs" / "stages"
    templates = ROOT / "benchmarks" / "surveys"  # of pages of docs/
    count = 0
    for page in (page for page in pages if page.parent != templates):
        for target in re.findall(r"\]\(([^)\s:]+)\)", page.read_text(encoding="utf-8")):
            name, _, heading = target.partition("#")
            path = (page.parent / name).resolve() if name else page
            assert path.exists() and not path.is_relative_to(generated), f"{page.name}: {target}"
            if heading and path.suffix == ".md":
                assert heading in anchors(path), f"{page.name}: {target}"
            count += 1
    assert count > 140


def test_the_card_of_the_shipped_model_is_of_what_was_measured_of_it(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks" / "surveys"))
    monkeypatch.delitem(
        sys.modules, "clouds", raising=False
    )  # that of benchmarks/papers has the same name
    card = runpy.run_path(str(ROOT / "benchmarks" / "surveys" / "card.py"))
    for path, text in card["pages"]().items():
        assert path.read_text(encoding="utf-8") == text, f"write {path.name} anew by card.py"
    short = runpy.run_path(str(ROOT / "docs" / "survey_table.py"))
    assert short["table"]().strip() in (ROOT / "README.md").read_text(encoding="utf-8")


made_town = functools.cache(ps.make_town)  # scripts of the gallery show the same towns


@pytest.mark.parametrize(
    "script", sorted((ROOT / "docs" / "gallery").glob("[0-9]*.py")), ids=lambda p: p.stem
)
def test_gallery_scripts_run(script, tmp_path, monkeypatch):
    monkeypatch.setenv("GALLERY_SIZE", "60")
    monkeypatch.setenv("GALLERY_OUTPUT", str(tmp_path))
    monkeypatch.syspath_prepend(str(script.parent))
    monkeypatch.delitem(sys.modules, "_common", raising=False)
    monkeypatch.setattr("pdal_stages.synthetic.make_town", made_town)
    runpy.run_path(str(script), run_name="__main__")
    assert (tmp_path / f"{script.stem}.png").read_bytes().startswith(b"\x89PNG")
    page = (ROOT / "docs" / "gallery" / "index.md").read_text(encoding="utf-8")
    assert f"pictures/{script.stem}.png" in page


def test_the_picture_of_the_architecture_is_of_this_code():
    drawn = runpy.run_path(str(ROOT / "docs" / "architecture_picture.py"))
    picture = drawn["TARGET"].read_text(encoding="utf-8")
    assert picture == drawn["picture"](), "run docs/architecture_picture.py"
    there = {f"{p.name}/" for p in (ROOT / "pdal_stages").iterdir() if (p / "__init__.py").exists()}
    rooms = " ".join(rooms for _, steps in drawn["COLUMNS"] for *_, rooms in steps).split()
    assert {*rooms, *(room for room, *_ in drawn["EXTRAS"])} <= there | {"PDAL", "qgis/"}
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^\| `(\w+/)` \|", page, re.MULTILINE)) == there
    for module in re.findall(r"`(\w+/\w+\.(?:py|cpp))`", page):
        assert (ROOT / "pdal_stages" / module).is_file() or (ROOT / module).is_file(), module
