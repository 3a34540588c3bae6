"""What a model is, for people: classes, features, samples, scores, importances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..base.errors import ModelError, OptionError
from ..base.plain import one_line
from .algorithms import ON_TOP, Column
from .thinning import range_text

#: The dimension in which the command `train` numbers its files.
FILE_NUMBER = "FileNumber"
GROUPINGS = ("column", "feature", "group", "neighborhood", "dimension")


def importances(
    values: Sequence[float] | None, columns: Sequence[Column], by: str = "feature"
) -> dict[str, float]:
    """See ``Model.importances``; one value per column."""
    if by not in GROUPINGS:
        raise OptionError(
            "importances are grouped by something unknown", found=by, cure=f"One of {GROUPINGS}"
        )
    if values is None:
        raise ModelError("the model file holds no importances")
    total: dict[str, float] = {}
    for column, value in zip(columns, values, strict=True):
        if by == "dimension":
            key = column.name if column.group == "dimension" else "(computed features)"
        else:
            key = getattr(column, "name" if by == "column" else by)
        total[key] = total.get(key, 0.0) + value
    return dict(sorted(total.items(), key=lambda item: -item[1]))


def describe(manifest: Mapping[str, Any], columns: Sequence[Sequence[Column]]) -> dict[str, Any]:
    """A manifest for people: importances grouped, long tables left out; `columns` of each pass."""
    passes = []
    for entry, its in zip(manifest["passes"], columns, strict=True):
        values = entry["importances"]
        kept = {k: v for k, v in entry.items() if k not in ("shape_bins", "percentiles", "importances")}
        if values is not None:
            kept["importances"] = {
                by: {key: round(value, 6) for key, value in importances(values, its, by).items()}
                for by in GROUPINGS[1:]
            }
        passes.append(kept)
    return {**manifest, "passes": passes}


def text(info: Mapping[str, Any]) -> str:
    """What :func:`describe` gives as a page of text."""
    info = _in_one_line(info)
    training, several = info["training"], len(info["passes"]) > 1
    lines = scores(info, training.get("held_out"))
    for number, one in _own_passes(info):
        if several:
            lines.append(f"pass {number}")
        numbers = [f"{v:,} {k}" for k, v in one["parameters"].items() if isinstance(v, int)]
        lines += [
            f"{one['algorithm']}: {', '.join(numbers)}",
            f"features       {len(one['feature_names'])}: {' '.join(one['features']['neighborhoods'])}",
        ]
        if one["context"]:
            lines.append(f"context        {' '.join(one['context'])}")
    lines += [
        f"needs          {', '.join(info['required_dimensions']) or 'coordinates only'}",
        f"halo           {info['halo_m']:g} m",
    ]
    if info.get("priors"):
        lines.append(f"prior weight   {info['priors']['weight']:g}")
    if info["strategy"] == "binary":
        lines.append(f"strategy       binary, target {info['target']}, background {info['background']}")
    if densities := info.get("densities"):
        lines.append(f"densities      {range_text(densities)} points/m2")
    if info.get("voxel"):
        lines.append(f"voxel          {info['voxel']:g} m, which one point stands for")
    if base := info.get("base"):
        lines.append(f"on top of      {base['name']}, the passes before (SHA-256 {base['sha256']})")
    for cloud in training["clouds"]:
        lines.append(f"trained on     {cloud['name']}, {cloud['points']:,} points")
    if teacher := info.get("teacher"):
        lines.append(
            f"labels         what {teacher['name']} is sure of ({teacher['sure']:g} and more); no person's"
        )
    if gone := training.get("contradicted"):
        lines.append(f"left out       labels that their height contradicts: {_counts(gone)}")
    lines += ["", f"{'class':<34}{'available':>12}{'samples':>10}{'duplicates':>12}{'F1 out of bag':>15}"]
    bag = out_of_bag(info)
    for entry in info["classes"]:
        f1 = (bag.get("f1") or {}).get(str(entry["code"]))
        lines.append(
            f"{entry['code']:>3} {_short(entry['name']):<30}{entry['available']:>12,}{entry['samples']:>10,}"
            f"{entry['duplicates']:>12,}{_percent(f1):>15}"
        )
    lines.append("")
    for number, one in _own_passes(info):
        if "importances" in one and several:
            lines.append(f"pass {number}")
        for by in ("neighborhood", "group", "feature") if "importances" in one else ():
            top = list(one["importances"][by].items())[:10]
            lines.append(f"importance by {by:<13}" + ", ".join(f"{k} {100 * v:.1f} %" for k, v in top))
    return "\n".join(lines)


def _own_passes(info: Mapping[str, Any]) -> list[tuple[int, Mapping[str, Any]]]:
    """A model's passes with their numbers; of one on top of a base not those of the base, which its own file describes."""
    passes = list(enumerate(info["passes"], 1))
    return [(number, one) for number, one in passes if one.get("algorithm") in ON_TOP] or passes


def out_of_bag(info: Mapping[str, Any]) -> Mapping[str, Any]:
    """The last pass's score; none where its labels were another model's answers."""
    return {} if info.get("teacher") else info["passes"][-1]["out_of_bag"] or {}


def _short(name: str) -> str:
    """A class's name as the table has room for it; codes of control characters stay whole."""
    return name if "\\" in name else name[:29]


def _in_one_line(value: Any) -> Any:
    """Names come from files and people: none of them may look like lines of ours."""
    if isinstance(value, str):
        return one_line(value)
    if isinstance(value, Mapping):
        return {_in_one_line(key): _in_one_line(inner) for key, inner in value.items()}
    return [_in_one_line(inner) for inner in value] if isinstance(value, list | tuple) else value


def scores(info: Mapping[str, Any], held_out: dict[str, Any] | None = None) -> list[str]:
    """Lines of scores, the most honest first; `held_out`: a network's own, over points as they lie."""
    if teacher := info.get("teacher"):
        return [
            f"not scored     {teacher['name']}'s answers are its labels; how right it is only your own tell",
            "",
        ]
    names = ("overall_accuracy", "kappa", "mean_f1")
    if isinstance(held_out, dict) and all(isinstance(held_out.get(n), float | None) for n in names):
        return [
            _scored("ground held out", held_out),
            "(it chose the best epoch, so it flatters a little)",
            "",
        ]
    lines = []
    crossed = info["accuracy"]["cross_validation"]
    rows = [(held_out_by(crossed), crossed and crossed["chosen"])]
    for number, one in _own_passes(info):
        rows.append((f"out of bag{f' {number}' if len(info['passes']) > 1 else ''}", one["out_of_bag"]))
    lines += [_scored(label, row) for label, row in rows if row]
    if unscored := info["training"].get("unscored"):
        lines.append(f"not scored     {unscored}")
    if lines:
        lines.append("(classes weigh the same; out of bag is flattered by neighboring samples)")
        lines.append("")
    return lines


def _scored(label: str, row: Mapping[str, Any]) -> str:
    values = [_percent(row.get(name)) for name in ("overall_accuracy", "kappa", "mean_f1")]
    return "{:<17}overall accuracy {}, kappa {}, mean F1 {}".format(label, *values)


def held_out_by(crossed: Mapping[str, Any] | None) -> str:
    """What the cross-validation held out: ``blocks held out``."""
    by = crossed.get("by", "blocks") if crossed else "blocks"
    return f"{groups_word(crossed['groups']) if by == 'groups' and crossed else by} held out"


def groups_word(dimension: str) -> str:
    """What the values of a dimension of groups stand for."""
    return "files" if dimension == FILE_NUMBER else dimension


def _counts(labels: Mapping[str, int]) -> str:
    return ", ".join(f"{number:,} of {label}" for label, number in labels.items())


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f} %"
