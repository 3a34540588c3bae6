"""Description of a model in words: accuracy, classes, inputs, training, importances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from ..base.json_types import JsonObject, StageJson
from ..base.messages import one_line
from .calibration import Calibration
from .model_info import DensityRange, ModelInfo

#: Most surveys that the text names, and most inputs by importance.
_SURVEYS = 40
_TOP = 10

#: Rows of the page: heading and text.
_Rows = list[tuple[str, str]]


class DescribedModel(Protocol):
    """The part of a ``Model`` that the text reads."""

    @property
    def info(self) -> ModelInfo:
        """The manifest without its passes."""

    @property
    def required_dimensions(self) -> Sequence[str]:
        """Dimensions that a cloud must have."""

    @property
    def optional_dimensions(self) -> Sequence[str]:
        """Dimensions that are used where a cloud has them."""

    @property
    def preparation(self) -> Sequence[StageJson]:
        """Stages that computed the training's dimensions."""

    @property
    def voxel(self) -> float:
        """Side of the voxels in meters."""

    @property
    def halo_m(self) -> float:
        """Meters around a tile."""

    @property
    def outdated(self) -> Sequence[str]:
        """Warnings about algorithms that have changed."""

    def manifest(self) -> JsonObject:
        """Return the manifest."""

    def importances(self, number: int = -1) -> Mapping[str, float]:
        """Return the importances of a pass."""


def text(model: DescribedModel) -> str:
    """Return a page of text about a model. Names come from its file, so every row is escaped."""
    info = model.info
    rows = [*_measured(info), *_inputs(model), *_passes(model), *_training(model)]
    rows += [("warning", warning) for warning in model.outdated]
    lines = [score(info), "", *(f"{name:<16}{value}".rstrip() for name, value in rows), ""]
    return "\n".join(map(one_line, [*lines, *_classes(info), ""]))


def _measured(info: ModelInfo) -> _Rows:
    """Return the share of right points on ground that was held out, by the class given."""
    if not info.get("sureness"):
        return []
    counts = Calibration.from_dict(info["sureness"])
    by_class = ", ".join(f"{c}: {_percent(counts.accuracy([c]))}" for c in sorted(counts.right))
    return [
        ("points right", f"{_percent(counts.accuracy(counts.right))}; of those given {by_class}"),
        ("", f"measured on {counts.about}"),
    ]


def _inputs(model: DescribedModel) -> _Rows:
    """Return dimensions and preprocessing."""
    info, versions = model.info, model.info["algorithms"]
    rows = [("reads", ", ".join(["X, Y, Z", *model.required_dimensions]))]
    if model.optional_dimensions:
        rows.append(("", f"{', '.join(model.optional_dimensions)}, where the points have them"))
    for stage in model.preparation:
        options = ", ".join(f"{k} {v}" for k, v in stage.items() if k != "type")
        version = f"version {versions.get(stage['type'], 'unknown')} of its algorithm"
        rows.append(("preprocessing", f"{stage['type']} ({options or 'as it is'}), {version}"))
    if info.get("by_hand"):
        rows.append(("preprocessing", f"{', '.join(info['by_hand'])}, which the file cannot carry"))
    return rows


def _passes(model: DescribedModel) -> _Rows:
    """Return the size of each classifier, what it reads, and which inputs matter most."""
    rows = []
    for number, entry in enumerate(model.manifest()["passes"]):
        sizes = [f"{v:,} {k}" for k, v in entry["parameters"].items() if isinstance(v, int)]
        text = f"{entry['algorithm'].replace('_', ' ')}, {', '.join(sizes)}"
        text += f"; reads {len(entry['feature_names'])} columns"
        if entry["neighborhoods"]:
            text += f" of {' '.join(entry['neighborhoods'])}"
        if entry["context"]:
            text += f" and of the pass before {' '.join(entry['context'])}"
        rows.append((f"pass {number + 1}", text))
        if entry["importances"] is not None:
            largest = list(model.importances(number).items())[:_TOP]
            shares = ", ".join(f"{name} {_percent(share)}" for name, share in largest)
            rows.append(("", f"importances {shares}"))
    return rows


def _training(model: DescribedModel) -> _Rows:
    """Return what it was trained on and where it holds."""
    info = model.info
    clouds = info["training"]["clouds"]
    surveys: list[str] = []  # the names of copies begin with that of their survey
    for cloud in clouds:
        if not any(cloud["name"].startswith((f"{name} ", f"{name},")) for name in surveys):
            surveys.append(cloud["name"])
    names = ", ".join(surveys[:_SURVEYS]) + " ..." * (len(surveys) > _SURVEYS)
    points = sum(cloud["points"] for cloud in clouds)
    size = f"{len(surveys)} surveys or files, {len(clouds)} clouds with copies, {points:,} points"
    rows = [("trained on", size), ("", names)]
    if base := info.get("base"):
        rows.append(("on top of", f"{base['name']}, the passes before (SHA-256 {base['sha256']})"))
    if info["strategy"] == "binary":
        rows.append(("strategy", f"binary, target {info['target']}"))
    return [
        *rows,
        ("densities", f"{range_text(info['densities'])} points/m2"),
        ("voxel", f"{model.voxel:g} m, which one point stands for"),
        ("halo", f"{model.halo_m:g} m around a tile"),
        ("written by", f"pdal_stages {info['created_by'].get('pdal_stages', 'unknown')}"),
    ]


def _classes(info: ModelInfo) -> list[str]:
    """Return the table of classes."""
    lines = [f"{'class':<34}{'available':>12}{'samples':>10}{'duplicates':>12}{'F1 held out':>13}"]
    f1 = held_out(info).get("f1") or {}
    for entry in info["classes"]:
        lines.append(
            f"{entry['code']:>3} {entry['name']:<30}{entry['available']:>12,}"
            f"{entry['samples']:>10,}{entry['duplicates']:>12,}"
            f"{_percent(f1.get(str(entry['code']))):>13}"
        )
    return lines


def range_text(densities: DensityRange) -> str:
    """Return ``0.3 to 46``, or one number where both are alike."""
    ends = densities["low"], densities["high"]
    return " to ".join(dict.fromkeys(f"{end:.3g}" for end in ends))


def held_out(info: ModelInfo) -> JsonObject:
    """Return the scores on held-out ground, of a forest by cross-validation; empty without any."""
    of_network = info["training"].get("held_out")
    crossed = info["accuracy"]["cross_validation"]
    return of_network if isinstance(of_network, dict) else crossed["chosen"] if crossed else {}


def score(info: ModelInfo) -> str:
    """Return the score in a line, or why there is none."""
    row = held_out(info)
    if not row and info.get("sureness"):
        share = _measured(info)[0][1].partition(";")[0]
        return f"measured       {share} of points right, on ground it had not seen"
    if not row:
        why = "no score in the file (the shipped model: docs/models.md)"
        return f"not scored     {info['training'].get('unscored', why)}"
    label = "ground held out, which chose the best epoch"
    if crossed := info["accuracy"]["cross_validation"]:
        label = f"{crossed.get('by', 'blocks')} held out"
    values = [_percent(row.get(name)) for name in ("overall_accuracy", "kappa", "mean_f1")]
    return "{:<15}  overall accuracy {}, kappa {}, mean F1 {}".format(label, *values)


def _percent(value: object) -> str:
    return f"{100 * value:.1f} %" if isinstance(value, float) else "-"
