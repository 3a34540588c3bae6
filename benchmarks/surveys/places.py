"""Six places where models are wrong, chosen by chance, in pictures.

    python benchmarks/surveys/places.py --data DIR --models MODELS --json JSON --picture FILE

Each survey is classified by the model that leave_one_out.py saved in MODELS, which has not seen its group.
Wrong points that touch are one patch. Patches are drawn with chances as their numbers of points, none twice nor beside
another, and of each one point.
Around it the picture has heights, what the model says and what is true, from above, and below both of these in a
vertical section.

JSON has a line per place. What is seen there is written into it by hand ("seen"), and kept as long as the place is drawn.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from clouds import Cloud, load, model_without
from leave_one_out import NAMES
from PIL import Image, ImageDraw
from scipy import ndimage
from sources import check
from surveys import SURVEYS

from pdal_stages import load_model
from pdal_stages.reports.views import BACKGROUND, CLASS_COLORS, png, triptych

PLACES, COLUMNS, SEED = 6, 2, 1
#: Points that a picture must show: of fewer nothing can be seen.
SHOWN = 200
#: A place is so many meters wide, and its section so high and, where points are dense, thick.
SIDE, HIGH, THICK = 36.0, 18.0, 2.0
#: Of a panel from above, of the space between panels, of a line of text, in pixels.
WIDTH, GAP, LINE = 190, 12, 16
INK, UNLABELED = (20, 20, 20), (170, 170, 170)


@dataclass(frozen=True, eq=False)
class Classified:
    """A survey, and what a model that has not seen it says: (n,) class codes."""

    cloud: Cloud
    given: np.ndarray

    @property
    def wrong(self) -> np.ndarray:
        """Rows of the points that are called something else than they are."""
        return np.flatnonzero((self.cloud.truth > 0) & (self.given != self.cloud.truth))

    @property
    def spacing(self) -> float:
        """Of points, in meters."""
        return self.cloud.density**-0.5


@dataclass(frozen=True, eq=False)
class Place:
    """A wrong point of a patch of so many."""

    of: Classified
    row: int
    points: int

    def near(self, other: Place) -> bool:
        """Whether one picture would show both."""
        away = self.of.cloud.xyz[self.row, :2] - other.of.cloud.xyz[other.row, :2]
        return self.of is other.of and bool((np.abs(away) < SIDE).all())

    @property
    def shown(self) -> np.ndarray:
        """(n,) points that the picture shows from above."""
        corner = self.of.cloud.xyz[self.row, :2] - SIDE / 2
        return (
            (self.of.cloud.xyz[:, :2] >= corner) & (self.of.cloud.xyz[:, :2] < corner + SIDE)
        ).all(axis=1)

    @property
    def told(self) -> dict[str, str | int]:
        """For JSON."""
        x, y, _ = self.of.cloud.xyz[self.row]
        truth, given = (
            NAMES[int(codes[self.row])] for codes in (self.of.cloud.truth, self.of.given)
        )
        at = {"survey": self.of.cloud.survey, "x": round(x), "y": round(y), "points": self.points}
        return {**at, "truth": truth, "given": given}


def patches(of: Classified) -> np.ndarray:
    """A number of each wrong point's patch, from 0: cells of two spacings, 1 m at least, that touch are one."""
    if not len(of.wrong):
        return np.zeros(0, int)
    cells = np.floor(of.cloud.xyz[of.wrong, :2] / max(2 * of.spacing, 1.0)).astype(int)
    column, row = (cells - cells.min(axis=0)).T
    taken = np.zeros((column.max() + 1, row.max() + 1), bool)
    taken[column, row] = True
    return ndimage.label(taken, np.ones((3, 3)))[0][column, row] - 1


def draw(surveys: list[Classified], random: np.random.Generator) -> list[Place]:
    """Places of different patches, no two in one picture: the more points, the likelier."""
    rows = np.concatenate([of.wrong for of in surveys])
    survey = np.repeat(np.arange(len(surveys)), [len(of.wrong) for of in surveys])
    within = np.concatenate([patches(of) for of in surveys])
    _, patch, size = np.unique(
        np.stack([survey, within]), axis=1, return_inverse=True, return_counts=True
    )
    patch, out = patch.ravel(), []
    for one in random.choice(len(size), len(size), replace=False, p=size / size.sum()):
        at = random.choice(np.flatnonzero(patch == one))
        place = Place(surveys[survey[at]], int(rows[at]), int(size[one]))
        if not any(place.near(other) for other in out) and place.shown.sum() >= SHOWN:
            out.append(place)
        if len(out) == PLACES:
            break
    return out


def from_above(place: Place, codes: np.ndarray) -> Image.Image:
    """Heights and classes, side by side, with the point and the line of the section."""
    xyz = place.of.cloud.xyz
    corner = xyz[place.row, :2] - SIDE / 2
    inside = place.shown
    x, y, z = xyz[inside].T
    scale = WIDTH / SIDE
    wide = max(int(scale * np.ptp(x)), 16)
    drawn = Image.fromarray(triptych(x, y, z, codes[inside], width=2 * wide + GAP))
    out = Image.new("RGB", (2 * WIDTH + GAP, WIDTH), BACKGROUND)
    left, top = int(scale * (x.min() - corner[0])), int(scale * (corner[1] + SIDE - y.max()))
    pen = ImageDraw.Draw(out)
    for panel in range(2):
        first = panel * (drawn.width - wide)
        out.paste(
            drawn.crop((first, 0, first + wide, drawn.height)), (panel * (WIDTH + GAP) + left, top)
        )
        x0, middle = panel * (WIDTH + GAP), WIDTH // 2
        pen.line((x0, middle, x0 + 10, middle), INK)
        pen.line((x0 + WIDTH - 10, middle, x0 + WIDTH, middle), INK)
        pen.ellipse((x0 + middle - 6, middle - 6, x0 + middle + 6, middle + 6), outline=INK)
    return out


def section(place: Place, codes: np.ndarray, width: int) -> Image.Image:
    """West to east through the point, all to one scale; dots are drawn by class, wrong ones in front."""
    xyz, scale = place.of.cloud.xyz, width / SIDE
    at, tall = xyz[place.row], int(HIGH * scale)
    dx, dy, _ = np.abs(xyz - at).T
    near = np.flatnonzero((dx < SIDE / 2) & (dy < max(THICK / 2, 1.5 * place.of.spacing)))
    low = max(at[2] - HIGH / 2, xyz[near, 2].min() - 1.0)
    near = near[np.argsort(np.isin(near, place.of.wrong), kind="stable")]
    out = Image.new("RGB", (width, tall), BACKGROUND)
    pen, size = ImageDraw.Draw(out), 1 if place.of.spacing < 0.35 else 1.5
    for row in near:
        across = scale * (xyz[row, 0] - at[0]) + width / 2
        down = tall - scale * (xyz[row, 2] - low)
        color = tuple(CLASS_COLORS[codes[row]].tolist()) if codes[row] else UNLABELED
        pen.ellipse((across - size, down - size, across + size, down + size), fill=color)
    down = tall - scale * (at[2] - low)
    pen.ellipse((width / 2 - 6, down - 6, width / 2 + 6, down + 6), outline=INK)
    return out


def picture(number: int, place: Place) -> Image.Image:
    """All views of a place, under its number and what is called what."""
    truth = place.of.cloud.truth
    wide = 3 * WIDTH + 2 * GAP
    half = (wide - GAP) // 2
    given, true = (section(place, codes, half) for codes in (place.of.given, truth))
    out = Image.new("RGB", (wide, WIDTH + given.height + 2 * LINE + GAP), BACKGROUND)
    told, pen = place.told, ImageDraw.Draw(out)
    pen.text((0, 0), f"{number}  {told['survey']}: {told['truth']} called {told['given']}", INK)
    out.paste(from_above(place, place.of.given), (0, LINE))
    out.paste(
        from_above(place, truth).crop((WIDTH + GAP, 0, 2 * WIDTH + GAP, WIDTH)),
        (2 * (WIDTH + GAP), LINE),
    )
    for words, panel, left in (("the model", given, 0), ("the truth", true, half + GAP)):
        out.paste(panel, (left, 2 * LINE + WIDTH))
        pen.text((left, LINE + WIDTH + 3), f"section, {words}", INK)
    return out


def sheet(places: list[Place]) -> np.ndarray:
    """The places in rows, left to right, under the legend, (height, width, 3) uint8."""
    pictures = [picture(number, place) for number, place in enumerate(places, 1)]
    wide, tall = (side + 2 * GAP for side in pictures[0].size)
    rows = -(-len(pictures) // COLUMNS)
    out = Image.new("RGB", (COLUMNS * wide, 2 * LINE + rows * tall), BACKGROUND)
    pen, left = ImageDraw.Draw(out), GAP
    for words, color in [
        *((name, tuple(CLASS_COLORS[code].tolist())) for code, name in NAMES.items()),
        ("not told", UNLABELED),
    ]:
        pen.rectangle((left, 6, left + 10, 16), fill=color)
        pen.text((left + 16, 5), words, INK)
        left += 110
    pen.text((left, 5), f"from above ({SIDE:g} m wide): heights, the model, the truth", INK)
    for number, one in enumerate(pictures):
        down, across = divmod(number, COLUMNS)
        out.paste(one, (GAP + across * wide, 2 * LINE + down * tall))
    return np.asarray(out)


def with_words(places: list[Place], file: Path) -> list[dict[str, str | int]]:
    """What is told of the places, with what was seen in those that the file has already."""
    known = json.loads(file.read_text()) if file.exists() else []
    out = []
    for place in places:
        same = [one for one in known if {**one, "seen": ""} == {**place.told, "seen": ""}]
        out.append({**place.told, "seen": same[0]["seen"] if same else ""})
    return out


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    options.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    options.add_argument(
        "--models", type=Path, required=True, help="folder that leave_one_out.py --save filled"
    )
    options.add_argument("--json", type=Path, required=True, help="what the places are")
    options.add_argument("--picture", type=Path, required=True, help="where the picture goes")
    args = options.parse_args()
    surveys = []
    for name, survey in SURVEYS.items():
        check(args.data, list(survey.files))
        cloud, model = load(args.data, name), load_model(model_without(args.models, name))
        surveys.append(Classified(cloud, model.predict(cloud.xyz, cloud.dimensions).classification))
        print(
            f"{name}: {len(surveys[-1].wrong):,} of {len(cloud.xyz):,} points are wrong", flush=True
        )
    places = draw(surveys, np.random.default_rng(SEED))
    args.picture.write_bytes(png(sheet(places)))
    args.json.write_text(json.dumps(with_words(places, args.json), indent=1) + "\n")


if __name__ == "__main__":
    main()
