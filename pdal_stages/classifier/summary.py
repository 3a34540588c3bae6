"""What is told of a model: classes, features, samples, scores, importances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..base.errors import ModelError, OptionError
from ..base.messages import one_line
from .algorithms import REFINED, Column

#: The dimension in which the command `train` numbers its files.
FILE_NUMBER = "FileNumber"
#: How many clouds a model's text names.
_CLOUDS = 8

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
        kept = {k: v for k, v in entry.items() if k not in ("shape_bins", "importances")}
        if entry["importances"] is not None:
            kept["importances"] = {
                by: {k: round(v, 6) for k, v in importances(entry["importances"], its, by).items()}
                for by in GROUPINGS[1:]
            }
        passes.append(kept)
    return {**manifest, "passes": passes}


def text(info: Mapping[str, Any]) -> str:
    """What :func:`describe` gives as a page of text."""
    info = _in_one_line(info)
    several = len(info["passes"]) > 1
    every = list(enumerate(info["passes"], 1))
    # A base's own file describes its passes.
    passes = [(number, one) for number, one in every if one["algorithm"] == REFINED] or every
    lines = [score(info), ""]
    for number, one in passes:
        name = f"pass {number}, {one['algorithm']}" if several else one["algorithm"]
        numbers = [f"{v:,} {k}" for k, v in one["parameters"].items() if isinstance(v, int)]
        lines += [
            f"{name}: {', '.join(numbers)}",
            f"features       {len(one['feature_names'])}: {' '.join(one['neighborhoods'])}",
            f"context        {' '.join(one['context']) or '-'}",
        ]
    clouds = info["training"]["clouds"]
    rows: list[tuple[str, Any, str]] = [
        ("needs", True, ", ".join(info["required_dimensions"]) or "coordinates only"),
        ("halo", True, f"{info['halo_m']:g} m"),
        ("prior weight", info.get("priors"), "{0[weight]:g}"),
        (
            "strategy",
            info["strategy"] == "binary",
            f"binary, target {info['target']}, background {info['background']}",
        ),
        (
            "densities",
            info.get("densities"),
            f"{range_text(info.get('densities') or {})} points/m2",
        ),
        ("voxel", info.get("voxel"), "{0:g} m, which one point stands for"),
        ("on top of", info.get("base"), "{0[name]}, the passes before (SHA-256 {0[sha256]})"),
        *(("trained on", c, "{0[name]}, {0[points]:,} points") for c in clouds[:_CLOUDS]),
        ("", len(clouds[_CLOUDS:]), "and {0:,} more (--showjson lists them)"),
        (
            "labels",
            info.get("teacher"),
            "what {0[name]} is sure of ({0[sure]:g} and more); no person's",
        ),
    ]
    lines += [f"{name:<15}{said.format(value)}" for name, value, said in rows if value]
    lines += [
        "",
        f"{'class':<34}{'available':>12}{'samples':>10}{'duplicates':>12}{'F1 held out':>13}",
    ]
    f1 = held_out(info).get("f1") or {}
    for entry in info["classes"]:
        name = entry["name"]
        name = name if "\\" in name else name[:29]  # codes of control characters stay
        lines.append(
            f"{entry['code']:>3} {name:<30}{entry['available']:>12,}{entry['samples']:>10,}"
            f"{entry['duplicates']:>12,}{_percent(f1.get(str(entry['code']))):>13}"
        )
    lines.append("")
    for number, one in passes:
        for by in ("neighborhood", "group", "feature") if "importances" in one else ():
            top = ", ".join(
                f"{k} {100 * v:.1f} %" for k, v in list(one["importances"][by].items())[:10]
            )
            lines.append(f"pass {number}: " * several + f"importance by {by:<13}{top}")
    return "\n".join(lines)


def range_text(densities: Mapping[str, float]) -> str:
    """``0.3 to 46``, or one number where both are alike."""
    return " to ".join(
        dict.fromkeys(f"{densities[one]:.3g}" for one in ("low", "high") if densities)
    )


def _in_one_line(value: Any) -> Any:
    """Names come from files and people: none of them may look like lines of ours."""
    if isinstance(value, str):
        return one_line(value)
    if isinstance(value, Mapping):
        return {_in_one_line(key): _in_one_line(inner) for key, inner in value.items()}
    return [_in_one_line(inner) for inner in value] if isinstance(value, list | tuple) else value


def held_out(info: Mapping[str, Any]) -> Mapping[str, Any]:
    """The figures on ground that was held out: a network's own, or those of the cross-validation; empty without."""
    if info.get("teacher"):
        return {}
    own = info["training"].get("held_out")
    crossed = info["accuracy"]["cross_validation"]
    return own if isinstance(own, dict) else crossed["chosen"] if crossed else {}


def score(info: Mapping[str, Any]) -> str:
    """The score in a line, or why there is none."""
    if teacher := info.get("teacher"):
        return f"not scored     its labels are answers of {teacher['name']}; only labels of your own tell how right it is"
    row = held_out(info)
    if not row:
        why = "no score in the file (the shipped model: docs/models.md)"
        return f"not scored     {info['training'].get('unscored', why)}"
    label = "ground held out, which chose the best epoch"
    if crossed := info["accuracy"]["cross_validation"]:
        by = crossed.get("by", "blocks")
        label = f"{groups_word(str(crossed.get('groups'))) if by == 'groups' else by} held out"
    values = [_percent(row.get(name)) for name in ("overall_accuracy", "kappa", "mean_f1")]
    return "{:<15}  overall accuracy {}, kappa {}, mean F1 {}".format(label, *values)


def groups_word(dimension: str) -> str:
    """What the values of a dimension of groups stand for."""
    return "files" if dimension == FILE_NUMBER else dimension


def _percent(value: Any) -> str:
    return f"{100 * value:.1f} %" if isinstance(value, float) else "-"
