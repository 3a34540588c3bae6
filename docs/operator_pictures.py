"""The pictures of "An hour of an operator": its commands, run in a folder of their own, and what they show.

    python benchmarks/surveys/leave_one_out.py --data DIR --save MODELS --surveys Seville
    python docs/operator_pictures.py --data DIR --models MODELS [--folder FOLDER]   # writes docs/pictures/operator-*.png

A raw tile of Seville is classified by a model that has not seen the survey. The person is simulated: he knows the true
classes, and corrects the five patches that come first. The commands are those of the page; what they print, and the CPU
seconds they took, are printed. The picture of the review page is taken by Chromium, where there is one.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyogrio
import shapely
from PIL import Image, ImageDraw

from pdal_stages.classifier.sureness import SUFFIX
from pdal_stages.models import find
from pdal_stages.objects.overlay import points_inside
from pdal_stages.reports.pictures import font, write_png
from pdal_stages.reports.raster import Frame
from pdal_stages.reports.views import error_view, section_view, top_view

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent / "benchmarks" / "surveys"))
from clouds import SURVEYS, true_classes  # noqa: E402
from corrections import PATCHES, corrected  # noqa: E402

SURVEY = "Seville"
GAP, WHITE, INK = 16, (255, 255, 255), (30, 30, 30)


def run(folder: Path, words: str) -> str:
    """A command in the folder, as the page has it; what it printed."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    code = "import sys; from pdal_stages.cli import main; sys.exit(main(sys.argv[1:]))"
    made = subprocess.run(
        [sys.executable, "-c", code, *words.split()[1:]], cwd=folder, capture_output=True, text=True
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"\n$ {words}      # {spent:.0f} CPU s\n{made.stdout}{made.stderr}", flush=True)
    if made.returncode:
        raise SystemExit(made.returncode)
    return made.stdout


def beside(*images: np.ndarray, titles: tuple[str, ...] = ()) -> np.ndarray:
    """Images in a row, with a line of text above each."""
    top = 28 if titles else 0
    sheet = Image.new(
        "RGB",
        (sum(i.shape[1] for i in images) + GAP * (len(images) - 1), top + max(i.shape[0] for i in images)),
        WHITE,
    )
    pen, left = ImageDraw.Draw(sheet), 0
    for number, image in enumerate(images):
        if titles:
            pen.text((left + 2, 14), titles[number], INK, font(), anchor="lm")
        sheet.paste(Image.fromarray(image), (left, top))
        left += image.shape[1] + GAP
    return np.array(sheet)


def outlined(image: np.ndarray, frame: Frame, shapes: list[Any], ranks: list[int]) -> np.ndarray:
    """A view from above with the outlines of polygons, and the rank of each."""
    sheet = Image.fromarray(image)
    pen = ImageDraw.Draw(sheet)
    for shape, rank in zip(shapes, ranks, strict=True):
        for part in shape.geoms:
            for ring in (part.exterior, *part.interiors):
                at = np.array(ring.coords)[:, :2]
                pixels = np.column_stack(
                    [(at[:, 0] - frame.x0) / frame.pixel, frame.height - (at[:, 1] - frame.y0) / frame.pixel]
                )
                pen.line([tuple(one) for one in pixels], fill=(20, 20, 200), width=2)
        middle = shape.representative_point()
        where = (
            (middle.x - frame.x0) / frame.pixel,
            frame.height - (middle.y - frame.y0) / frame.pixel,
        )
        pen.text(where, str(rank), (0, 0, 0), font(24), anchor="mm", stroke_width=3, stroke_fill=WHITE)
    return np.array(sheet)


def columns(path: Path) -> tuple[np.ndarray, ...]:
    """x, y, z and classes of a file."""
    las = laspy.read(path)
    return tuple(np.asarray(values) for values in (las.x, las.y, las.z, las.classification))


def mark_done(path: Path, layer: Any) -> None:
    """Set ``done`` of the first patches, as a person does in a table of attributes."""
    about, _, geometry, values = layer
    names = list(about["fields"])
    values[names.index("done")][:PATCHES] = 1
    pyogrio.raw.write(
        path,
        geometry,
        values,
        names,
        layer="patches",
        driver="GPKG",
        crs=about["crs"],
        geometry_type=about["geometry_type"],
    )


def page_picture(folder: Path, target: Path) -> None:
    """The top of the review's page as a browser shows it."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        print("no Chromium: the picture of the page stays as it is")
        return
    wanted = folder / "page.png"
    subprocess.run(
        [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=1200,1500",
         f"--screenshot={wanted}", (folder / "review.html").as_uri()],
        check=True, capture_output=True,
    )  # fmt: skip
    write_png(target, np.array(Image.open(wanted).convert("RGB")), palette=True)


def hour(data: Path, model: Path, folder: Path, pictures: Path) -> None:
    """All steps, and their pictures."""
    survey = SURVEYS[SURVEY]
    las = laspy.read(data / survey.files[0])
    las.points = las.points[~np.isin(las.classification, survey.dropped)]
    las.write(folder / "raw.laz")
    shutil.copyfile(model, folder / "base.model")
    shutil.copyfile(Path(find("standard")).with_suffix(SUFFIX), folder / f"base{SUFFIX}")

    run(folder, "pdal-stages classify raw.laz classified.laz --model base.model --no-progress")
    x, y, z, codes = columns(folder / "classified.laz")
    height = np.asarray(laspy.read(folder / "classified.laz")["HeightAboveGround"])
    truth = true_classes(survey, x, y, np.asarray(las.classification), height)
    frame = Frame.around(x, y, 560)
    heights = top_view(x, y, z, values=np.full(len(z), np.nan), limits=(0, 1), width=560)
    classes = top_view(x, y, z, codes, width=560)
    write_png(pictures / "operator-classified.png", beside(heights, classes), palette=True)

    run(folder, "pdal-stages review classified.laz review.gpkg --no-progress")
    page_picture(folder, pictures / "operator-page.png")
    layer = pyogrio.raw.read(folder / "review.gpkg", layer="patches")
    shapes = list(shapely.from_wkb(layer[2])[:PATCHES])
    ranks = list(range(1, len(shapes) + 1))
    known = truth > 0
    errors = error_view(x, y, z, known & (codes != truth), ~known, width=560)
    write_png(
        pictures / "operator-list.png",
        beside(
            outlined(classes, frame, shapes, ranks),
            errors,
            titles=("The five patches that come first", "What is wrong (red), which nobody knows"),
        ),
        palette=True,
    )

    inside = points_inside(x, y, shapes)
    new = corrected(folder / "classified.laz", folder / "corrected.laz", truth, inside)
    mark_done(folder / "review.gpkg", layer)
    run(
        folder,
        "pdal-stages corrections classified.laz corrected.laz --area review.gpkg --out checked.laz",
    )
    write_png(
        pictures / "operator-corrected.png", _before_and_after(x, y, z, codes, new, shapes[0]), palette=True
    )

    run(folder, "pdal-stages train --base base.model checked.laz --model mine.model --no-progress")
    run(folder, "pdal-stages classify raw.laz second.laz --model mine.model --no-progress")
    second = columns(folder / "second.laz")[3]
    after = error_view(x, y, z, known & (second != truth), ~known, width=560)
    titles = tuple(
        f"{what}: {100 * np.mean(given[known] != truth[known]):.1f} % wrong"
        for what, given in (("Before", codes), ("After one round", second))
    )
    write_png(pictures / "operator-second.png", beside(errors, after, titles=titles), palette=True)
    run(folder, "pdal-stages review second.laz review2.gpkg --no-progress")

    las.classification = truth
    las.write(folder / "truth.laz")
    run(folder, "pdal-stages accuracy second.laz --reference truth.laz")
    run(
        folder,
        "pdal-stages classify raw.laz sure.laz --model mine.model --keep-sure 0.95 --no-progress",
    )
    sure = columns(folder / "sure.laz")[3]
    for code in (2, 5, 6):
        kept, all_ = (known & (given == code) for given in (sure, second))
        right, before = (100 * np.mean(truth[mine] == code) for mine in (kept, all_))
        print(
            f"class {code}: {100 * kept.sum() / all_.sum():.1f} % stay, {right:.1f} % of these right (of all {before:.1f} %)"
        )


def _before_and_after(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, before: np.ndarray, after: np.ndarray, shape: Any
) -> np.ndarray:
    """A patch and its surroundings in the classes it had and has, from above and in section."""
    west, south, east, north = shape.bounds
    near = (x >= west - 4) & (x <= east + 4) & (y >= south - 4) & (y <= north + 4)
    mine = points_inside(x, y, [shape]) & (before != after)
    row = float(np.median(y[mine])) if mine.any() else 0.5 * (south + north)
    rows = []
    for codes in (before, after):
        above = top_view(x[near], y[near], z[near], codes[near], width=420)
        ends = (west - 4, row), (east + 4, row)
        cut = section_view(
            x[near], y[near], z[near], codes[near], start=ends[0], end=ends[1], thickness=3.0, width=700
        )
        rows.append(
            beside(above, cut, titles=("As the model gave it", "") if codes is before else ("Corrected", ""))
        )
    wide = max(row.shape[1] for row in rows)
    return np.concatenate(
        [np.pad(r, ((0, GAP), (0, wide - r.shape[1]), (0, 0)), constant_values=255) for r in rows]
    )


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    options.add_argument(
        "--models", type=Path, required=True, help="folder that leave_one_out.py --save filled"
    )
    options.add_argument("--folder", type=Path, help="where the commands run; default: one that is removed")
    options.add_argument("--pictures", type=Path, default=DOCS / "pictures")
    args = options.parse_args()
    model = (args.models / f"{SURVEY}.model").resolve()
    if args.folder:
        args.folder.mkdir(parents=True)  # a clean one
        hour(args.data, model, args.folder, args.pictures)
    else:
        with tempfile.TemporaryDirectory() as folder:
            hour(args.data, model, Path(folder), args.pictures)


if __name__ == "__main__":
    main()
