"""How well `review` tells where the errors are, and the calibration that it comes with.

    python benchmarks/surveys/review.py --data DIR --models MODELS [--json FILE] [--ship]

--ship writes what the package comes with: after the shipped model was built anew, this one command renews it. MODELS may
be a new folder: the models that miss a survey each are then made there (about 10 CPU minutes).

Each survey is classified, by the command, with the model that has not seen it, and then reviewed with a calibration
learned from the other surveys alone. Figures: points expected wrong beside those that are; the share of the wrong points
in the patches that come first, up to a tenth of the area, beside what reliability alone finds and what knowing the truth
would. What is not ground, vegetation or building in the labels is not counted. --out writes the calibration learned from
all surveys, --sureness the counts of right and wrong points by reliability, for `classify --keep-sure`.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from calibrating import learned_factors, learned_rates
from clouds import SURVEYS, slug, true_classes
from folds import TREES, LeaveOneOut

import pdal_stages
from pdal_stages import cli
from pdal_stages.classifier.sureness import Sureness
from pdal_stages.review import Calibration, Outlook, Records, Settings, find_patches, side_for
from pdal_stages.review.cells import BINS, GROUP_OF, PARTS, bins_of, cell_keys
from pdal_stages.review.expected import binned, kinds_of, outlook
from pdal_stages.review.signals import JUDGED, signals

#: The part of the area that is looked at first.
FIRST = 0.1


@dataclass
class Classified:
    """A survey's points as a model that has not seen it classified them."""

    name: str
    xyz: np.ndarray
    codes: np.ndarray
    reliability: np.ndarray
    height: np.ndarray
    strip: np.ndarray
    label: np.ndarray

    @cached_property
    def truth(self) -> np.ndarray:
        """True classes, 0 where they are not known."""
        x, y, _ = self.xyz.T
        return true_classes(SURVEYS[self.name], x, y, self.label, self.height)

    @cached_property
    def bins(self) -> np.ndarray:
        """The bin of each point in the tables of rates."""
        return bins_of(self.codes, self.reliability, self.height)

    @cached_property
    def side(self) -> float:
        cells = len(np.unique(np.floor(self.xyz[:, :2] / 4.0), axis=0))
        return side_for(len(self.xyz), 16.0 * cells)

    def histograms(self) -> tuple[np.ndarray, np.ndarray]:
        """Wrong and known points in each bin of group, reliability and height."""
        known = self.truth > 0
        wrong = known & (GROUP_OF[self.truth] != GROUP_OF[self.codes])
        size = 4 * BINS[0] * BINS[1]
        return tuple(
            np.bincount(self.bins[one], minlength=size).reshape(4, *BINS).astype(float)
            for one in (wrong, known)
        )

    @cached_property
    def _records(self) -> Records:
        none = np.zeros((4, *BINS))
        points = self.xyz, self.codes, self.reliability, self.height
        return Records.of(*points, self.side, none, strip=self.strip, truth=self.truth)

    @cached_property
    def _place(self) -> np.ndarray:
        """The cell and the group of each point."""
        column, row = (np.floor(self.xyz[:, axis] / self.side).astype(np.int64) for axis in (0, 1))
        return np.searchsorted(self._records.key, cell_keys(row, column)) * 4 + GROUP_OF[self.codes]

    def records(self, rates: np.ndarray) -> Records:
        """Those of the survey; only what is expected depends on the rates, so the rest is made once."""
        share = np.rint(rates.ravel() * PARTS)[self.bins]
        expected = np.bincount(self._place, share, 4 * len(self._records)).astype(np.int64)  # whole: exact
        return replace(self._records, expected=expected.reshape(-1, 4))


def classified(data: Path, name: str, model: Path, kept: Path) -> Classified:
    """A survey's files, classified by the command; kept in a folder as long as the model stays the same."""
    path = kept / f"{slug(name)}.npz"
    if not path.exists() or path.stat().st_mtime < model.stat().st_mtime:
        with tempfile.TemporaryDirectory() as folder:
            np.savez(path, **_classify(data, name, model, Path(folder)))
    with np.load(path) as held:
        return Classified(name, **{key: held[key] for key in held.files})


def _classify(data: Path, name: str, model: Path, folder: Path) -> dict[str, np.ndarray]:
    survey = SURVEYS[name]
    (folder / "raw").mkdir()
    codes = []
    for number, file in enumerate(survey.files):
        las = laspy.read(data / file)
        las.points = las.points[~np.isin(las.classification, survey.dropped)]
        codes.append(np.asarray(las.classification).astype(np.uint8))
        las.write(folder / "raw" / f"{number}.laz")
    inputs = [str(path) for path in sorted((folder / "raw").iterdir())]
    target = str(folder / "classified") + "/"
    assert cli.main(["classify", *inputs, target, "--model", str(model), "--no-progress"]) == 0
    found = [laspy.read(folder / "classified" / Path(one).name) for one in inputs]
    label = np.concatenate(codes)
    height = np.concatenate([np.asarray(las["HeightAboveGround"]) for las in found]).astype(np.float32)
    xyz = np.concatenate([np.column_stack([las.x, las.y, las.z]) for las in found]).astype(float)
    out = {
        "xyz": xyz,
        "codes": np.concatenate([np.asarray(las.classification) for las in found]).astype(np.uint8),
        "reliability": np.concatenate([np.asarray(las["Reliability"]) for las in found]).astype(np.float32),
        "height": height,
        "strip": np.concatenate([np.asarray(las.point_source_id) for las in found]),
        "label": label,
    }
    there = ~np.isin(out["codes"], (7, 18)) & (out["reliability"] > 0)  # overlap keeps its class
    return {key: values[there] for key, values in out.items()}


def learned(surveys: Sequence[Classified], about: dict[str, Any]) -> Calibration:
    """The calibration of some surveys."""
    counts = [one.histograms() for one in surveys]
    wrong, known = (np.stack(part) for part in zip(*counts, strict=True))
    weight = survey_weights(known.sum(axis=(1, 2, 3)))
    rates = learned_rates(wrong, known, weight)
    records = [one.records(rates) for one in surveys]
    found = [signals(one) for one in records]
    base, factors = [], []
    for group in JUDGED:
        bins = np.concatenate([binned(one, group) for one in found])
        rate = np.concatenate([one.rate[:, group] for one in found])
        bad = np.concatenate([one.wrong[:, group] for one in records]).astype(float)
        all_ = np.concatenate([one.known[:, group] for one in records]).astype(float)
        each = np.repeat(weight, [len(one) for one in records])
        there = all_ > 0
        b, f = learned_factors(bins[there], rate[there], bad[there], all_[there], each[there])
        base.append(b)
        factors.append(f)
    kinds = np.concatenate([kinds_of(one) for one in found])
    number, times = np.unique(kinds, return_counts=True)
    return Calibration(rates, tuple(factors), np.array(base), frozenset(number[times >= 5].tolist()), about)


def sureness(surveys: Sequence[Classified]) -> Sureness:
    """How often the models were right where they were how sure, where the labels say what vegetation is."""
    told = [one for one in surveys if not SURVEYS[one.name].tall]
    out = Sureness(
        about=f"{len(told)} surveys ({', '.join(one.name for one in told)}), each classified by a model that had not seen it"
    )
    # Between all points alike and all surveys alike: limits should hold in a survey, not in the sum of all.
    points = np.array([float(np.count_nonzero(one.truth)) for one in told])
    weight = points**-0.25 * points.sum() / (points**0.75).sum()
    for one, of_point in zip(told, weight, strict=True):
        known = (one.truth > 0) & np.isin(one.codes, (2, 5, 6))
        out.add(one.codes[known], one.truth[known], one.reliability[known], np.full(known.sum(), of_point))
    return out


def survey_weights(points: np.ndarray) -> np.ndarray:
    """Of a point of each survey: between all points alike and all surveys alike, so that no large one decides alone."""
    return points**-0.5 * points.sum() / (points**0.5).sum()


def judged(one: Classified, calibration: Calibration) -> dict[str, Any]:
    """What the review of a survey finds, beside the truth."""
    records = one.records(calibration.rates)
    seen = outlook(records, calibration)
    part = records.known[:, :3] / np.maximum(records.points[:, :3], 1)
    expected = float((seen.errors * part).sum())
    true = records.wrong[:, :3].sum(axis=1)
    plain = records.expected[:, :3].sum(axis=1) / PARTS
    return {
        "survey": one.name,
        "points": int(records.known[:, :3].sum()),
        "wrong": int(true.sum()),
        "expected": expected,
        "by_reliability": float((records.expected[:, :3] / PARTS * part).sum()),
        "found": _first(seen, true),
        "found_by_reliability": _first(
            Outlook(records, seen.found, plain[:, None] * [[1, 0, 0]], seen.unknown), true
        ),
        "best": _first(Outlook(records, seen.found, true[:, None] * [[1.0, 0, 0]], seen.unknown), true),
        "listed": _listed(seen, true),
    }


def _listed(seen: Outlook, true: np.ndarray) -> list[list[float]]:
    """Of each patch, in the order of the list: errors expected per minute, square meters, wrong points."""
    patches = find_patches(seen, Settings(cell=seen.records.side))
    held = np.bincount(patches.of_cell, true, len(patches))
    return np.stack([patches.errors / patches.minutes, patches.area, held], axis=1).tolist()


def _first(seen: Outlook, true: np.ndarray) -> float:
    """Share of the wrong points in the patches that come first, up to a tenth of the area; of the last as much as fits."""
    return share_first(np.array(_listed(seen, true)))


def share_first(listed: np.ndarray) -> float:
    """The same of what :func:`_listed` gives."""
    area, held = np.cumsum(listed[:, 1]), np.cumsum(listed[:, 2])
    at = np.interp(FIRST * area[-1], np.append(0.0, area), np.append(0.0, held))
    return float(at / max(held[-1], 1))


def table(rows: Sequence[dict[str, Any]]) -> str:
    """As Markdown."""
    lines = [
        "| survey | points judged | wrong | expected | expected / wrong | in the first 10 % | by reliability | at best |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        lines.append(
            f"| {row['survey']} | {row['points']:,} | {row['wrong']:,} | {row['expected']:,.0f} | "
            f"{row['expected'] / max(row['wrong'], 1):.2f} | {100 * row['found']:.0f} % | "
            f"{100 * row['found_by_reliability']:.0f} % | {100 * row['best']:.0f} % |"
        )
    total = {key: sum(row[key] for row in rows) for key in ("points", "wrong", "expected")}
    one_list = np.concatenate([row["listed"] for row in rows])
    together = share_first(one_list[np.argsort(-one_list[:, 0], kind="stable")])
    lines.append(
        f"| **all, in one list** | {total['points']:,} | {total['wrong']:,} | {total['expected']:,.0f} | "
        f"**{total['expected'] / max(total['wrong'], 1):.2f}** | **{100 * together:.0f} %** | | |"
    )
    return "\n".join(lines)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    options.add_argument(
        "--models",
        type=Path,
        required=True,
        help="folder of the models; those that leave_one_out.py --save has not left there are made",
    )
    options.add_argument("--trees", type=int, default=TREES, help="of a forest of a model that is made")
    options.add_argument(
        "--kept", type=Path, help="folder for the classified surveys; default: that of the models"
    )
    options.add_argument("--surveys", nargs="+", default=list(SURVEYS), choices=list(SURVEYS))
    options.add_argument("--json", type=Path, help="where the figures go")
    options.add_argument("--out", type=Path, help="where the calibration of all surveys goes")
    options.add_argument("--sureness", type=Path, help="where the counts behind --keep-sure go")
    options.add_argument(
        "--ship", action="store_true", help="both where the package has them, beside the shipped model"
    )
    options.add_argument(
        "--only-learn", action="store_true", help="no figures, only what --out and --sureness write"
    )
    args = options.parse_args()
    calibrate(args)


def make_models(data: Path, folder: Path, surveys: Sequence[str], trees: int) -> None:
    """The models that miss a survey each, where the folder has none."""
    folder.mkdir(parents=True, exist_ok=True)
    missing = [name for name in surveys if not (folder / f"{slug(name)}.model").exists()]
    if missing:
        with tempfile.TemporaryDirectory() as features:
            left_out = LeaveOneOut(data, SURVEYS, Path(features), trees)
            for name in missing:
                left_out.without(name).save(folder / f"{slug(name)}.model")
                print(f"a model without {name}", flush=True)


def calibrate(args: argparse.Namespace) -> None:
    """Score the reviews, and learn the calibration, as the command's options say."""
    kept = args.kept or args.models
    if args.ship:
        package = Path(pdal_stages.__file__).parent
        args.out, args.sureness = package / "review/standard.json", package / "models/standard.sureness.json"
    make_models(args.data, args.models, args.surveys, args.trees)
    all_ = [classified(args.data, name, args.models / f"{slug(name)}.model", kept) for name in args.surveys]
    rows = []
    for one in [] if args.only_learn else all_:
        others = learned([other for other in all_ if other is not one], {})
        rows.append(judged(one, others))
        print(json.dumps({key: value for key, value in rows[-1].items() if key != "listed"}), flush=True)
    if rows:
        print(table(rows))
    if args.json:
        shown = [{key: value for key, value in row.items() if key != "listed"} for row in rows]
        args.json.write_text(json.dumps(shown, indent=1) + "\n")
    if args.out:
        about = {"surveys": args.surveys, "command": "python benchmarks/surveys/review.py"}
        args.out.write_text(learned(all_, about).to_json() + "\n")
    if args.sureness:
        args.sureness.write_text(json.dumps(sureness(all_).to_dict(), separators=(",", ":")) + "\n")


if __name__ == "__main__":
    main()
