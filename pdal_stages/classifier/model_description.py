"""Description of a model in words: accuracy, classes, inputs, training, importances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..base.errors import ModelError, OptionError
from ..base.messages import one_line
from ..features.neighborhoods import parse_neighborhoods
from .calibration import Calibration
from .context_features import CELLS, OWN, SEGMENTS
from .interface import Column
from .registry import REFINED_FOREST

#: The dimension in which the command `train` numbers its files.
FILE_NUMBER = "FileNumber"
#: Most surveys that the text names, and most inputs by importance.
_SURVEYS = 40
_TOP = 10
#: Kind of neighborhood -> its words.
_KINDS = {
    "cylinder": "vertical cylinder of {0:g} m radius",
    "sphere": "sphere of {0:g} m radius",
    "knn": "the {0:g} nearest points",
    "kopt": "the best of {0:g} to {1:g} nearest points",
    "ropt": "the best radius of {0:g} to {1:g} m",
    "rdim": "the best radius of {0:g} to {1:g} m, by dimensionality",
    "copt": "radius or number of points by curvature",
}

GROUPINGS = ("column", "feature", "group", "neighborhood", "dimension")


def importances(
    values: Sequence[float] | None, columns: Sequence[Column], by: str = "feature"
) -> dict[str, float]:
    """Return importances by a grouping, see ``Model.importances``; `values` has one per column."""
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
    """Return a manifest without long tables, and with importances by group.

    Parameters
    ----------
    manifest : mapping
    columns : sequence of sequence of Column
        Inputs of each pass.
    """
    passes = []
    for entry, inputs in zip(manifest["passes"], columns, strict=True):
        kept = {k: v for k, v in entry.items() if k not in ("shape_bins", "importances")}
        kept["features"] = by_neighborhood(inputs)
        if entry["importances"] is not None:
            kept["importances"] = {
                by: {
                    name: round(share, 6)
                    for name, share in importances(entry["importances"], inputs, by).items()
                }
                for by in GROUPINGS[1:]
            }
        passes.append(kept)
    return {**manifest, "passes": passes}


def by_neighborhood(columns: Sequence[Column]) -> dict[str, list[str]]:
    """Return the names of each neighborhood's features; the bins of a histogram are one."""
    counts: dict[str, dict[str, int]] = {}
    for column in columns:
        if column.group not in ("dimension", "context"):
            bins = counts.setdefault(column.neighborhood, {})
            bins[column.feature] = bins.get(column.feature, 0) + 1
    return {
        token: [name if count == 1 else f"{name} ({count} bins)" for name, count in bins.items()]
        for token, bins in counts.items()
    }


def text(info: Mapping[str, Any]) -> str:
    """Return what :func:`describe` gives as a page of text."""
    info = _in_one_line(info)
    several = len(info["passes"]) > 1
    every = list(enumerate(info["passes"], 1))
    # A base's own file describes its passes.
    refined = [each for each in every if each[1]["algorithm"] == REFINED_FOREST]
    passes = refined or every
    rows = [*_measured(info), *_inputs(info, passes), *_passes(passes, several), *_training(info)]
    rows += [("warning", warning) for warning in info["outdated"]]
    lines = [score(info), "", *(f"{name:<16}{value}".rstrip() for name, value in rows), ""]
    lines += [*_classes(info), ""]
    for number, entry in passes:
        for by in ("neighborhood", "group", "feature") if "importances" in entry else ():
            largest = list(entry["importances"][by].items())[:_TOP]
            top = ", ".join(f"{name} {100 * share:.1f} %" for name, share in largest)
            lines.append(f"pass {number}: " * several + f"importance by {by:<13}{top}")
    return "\n".join(lines)


#: Rows of the page: heading and text.
_Rows = list[tuple[str, str]]


def _measured(info: Mapping[str, Any]) -> _Rows:
    """Return the share of right points on ground that was held out, by the class given."""
    if not info.get("sureness"):
        return []
    counts = Calibration.from_dict(info["sureness"])
    shares = {code: counts.accuracy([code]) for code in sorted(counts.right)}
    by_class = ", ".join(f"{code}: {_percent(share)}" for code, share in shares.items())
    return [
        ("points right", f"{_percent(counts.accuracy(counts.right))}; of those given {by_class}"),
        ("", f"measured on {counts.about}"),
    ]


def _inputs(info: Mapping[str, Any], passes: Sequence[tuple[int, Mapping[str, Any]]]) -> _Rows:
    """Return dimensions, preprocessing, features by neighborhood, and context."""
    versions = info.get("algorithms", {})
    rows = [("reads", ", ".join(["X, Y, Z", *info["required_dimensions"]]))]
    if info["optional_dimensions"]:
        rows.append(("", f"{', '.join(info['optional_dimensions'])}, where the points have them"))
    for stage in info.get("preparation") or []:
        options = ", ".join(f"{k} {v}" for k, v in stage.items() if k != "type")
        version = versions.get(stage["type"])
        known = "" if version is None else f", version {version} of its algorithm"
        rows.append(("preprocessing", f"{stage['type']}{f' ({options})' * bool(options)}{known}"))
    if info.get("by_hand"):
        rows.append(("preprocessing", f"{', '.join(info['by_hand'])}, which the file cannot carry"))
    tokens: dict[str, list[str]] = {}  # list of features -> neighborhoods that have it
    for _, entry in passes:
        for token, names in entry["features"].items():
            listed = ", ".join(names)
            if token in tokens.setdefault(listed, []):
                continue
            text = f"those of {tokens[listed][0]}" if tokens[listed] else listed
            tokens[listed].append(token)
            rows.append(("features", f"{_describe(token)}: {len(names)} features, {text}"))
    if tokens and "filters.multiscalefeatures" in versions:
        rows.append(("", f"version {versions['filters.multiscalefeatures']} of their algorithm"))
    read = dict.fromkeys(token for _, entry in passes for token in entry["context"])
    return rows + [("context", f"{token}, {_describe_context(token)}") for token in read]


def _describe_context(token: str) -> str:
    """Return a token of the context of a pass in words."""
    if token == OWN:
        return "probabilities of the pass before at the point itself"
    if token.startswith(SEGMENTS):
        return (
            f"what the object of class {token.removeprefix(SEGMENTS)} in the point's cell is like"
        )
    word = max((word for word in CELLS if token.startswith(word)), key=len)
    axes, votes = CELLS[word]
    where = (
        f"{'cells' if axes == 3 else 'columns'} of {token.removeprefix(word)} m around the point"
    )
    what = "share of points by class" if votes else "mean probabilities"
    return f"{what} of the pass before in the {3**axes} {where}"


def _describe(token: str) -> str:
    (neighborhood,) = parse_neighborhoods(token)
    return f"{token}, {_KINDS[neighborhood.kind].format(*neighborhood.parameters)}"


def _passes(passes: Sequence[tuple[int, Mapping[str, Any]]], several: bool) -> _Rows:
    """Return the size of each classifier and how many columns of which kind it reads."""
    rows = []
    for number, entry in passes:
        sizes = [f"{v:,} {k}" for k, v in entry["parameters"].items() if isinstance(v, int)]
        text = f"{entry['algorithm'].replace('_', ' ')}, {', '.join(sizes)}"
        features = sum(map(len, entry["features"].values()))
        text += f"; reads {features} features, {len(entry['dimensions'])} dimensions"
        if entry["context"]:
            text += f" and, of the pass before, {' '.join(entry['context'])}"
        rows.append((f"pass {number}" if several else "classifier", text))
    return rows


def _training(info: Mapping[str, Any]) -> _Rows:
    """Return what it was trained on and where it holds."""
    clouds = info["training"]["clouds"]
    heads = [cloud["name"].partition(", ")[0] for cloud in clouds]  # copies follow the comma
    surveys = list(
        dict.fromkeys(
            cloud["name"] if heads.count(head) == 1 else head
            for cloud, head in zip(clouds, heads, strict=True)
        )
    )
    more = f" and {len(surveys) - _SURVEYS} more (--showjson lists them)"
    names = ", ".join(surveys[:_SURVEYS]) + more * (len(surveys) > _SURVEYS)
    points = sum(cloud["points"] for cloud in clouds)
    size = f"{len(surveys)} surveys or files, {len(clouds)} clouds with copies, {points:,} points"
    density = f"{range_text(info.get('densities') or {})} points/m2"
    binary = f"binary, target {info['target']}, background {info['background']}"
    sure = "what {0[name]} is sure of ({0[sure]:g} and more); no person's"
    rows: list[tuple[str, Any, str]] = [
        ("trained on", clouds, size),
        ("", clouds, names.replace("{", "{{").replace("}", "}}")),
        ("labels", info.get("teacher"), sure),
        ("on top of", info.get("base"), "{0[name]}, the passes before (SHA-256 {0[sha256]})"),
        ("densities", info.get("densities"), density),
        ("voxel", info.get("voxel"), "{0:g} m, which one point stands for"),
        ("halo", info["halo_m"], "{0:g} m around a tile"),
        ("prior weight", info.get("priors"), "{0[weight]:g}"),
        ("strategy", info["strategy"] == "binary", binary),
        ("written by", info["created_by"].get("pdal_stages"), "pdal_stages {0}"),
    ]
    return [(name, text.format(value)) for name, value, text in rows if value]


def _classes(info: Mapping[str, Any]) -> list[str]:
    """Return the table of classes."""
    lines = [f"{'class':<34}{'available':>12}{'samples':>10}{'duplicates':>12}{'F1 held out':>13}"]
    f1 = held_out(info).get("f1") or {}
    for entry in info["classes"]:
        name = entry["name"]
        name = name if "\\" in name else name[:29]  # codes of control characters stay
        lines.append(
            f"{entry['code']:>3} {name:<30}{entry['available']:>12,}{entry['samples']:>10,}"
            f"{entry['duplicates']:>12,}{_percent(f1.get(str(entry['code']))):>13}"
        )
    return lines


def range_text(densities: Mapping[str, float]) -> str:
    """Return ``0.3 to 46``, or one number where both are alike; empty for an empty mapping."""
    ends = (f"{densities[end]:.3g}" for end in ("low", "high") if densities)
    return " to ".join(dict.fromkeys(ends))


def _in_one_line(value: Any) -> Any:
    """Escape line breaks in all texts: names come from files, and must not look like rows."""
    if isinstance(value, str):
        return one_line(value)
    if isinstance(value, Mapping):
        return {_in_one_line(key): _in_one_line(inner) for key, inner in value.items()}
    return [_in_one_line(inner) for inner in value] if isinstance(value, list | tuple) else value


def held_out(info: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the scores on ground that was held out; empty where there are none.

    A network has its own; a forest has those of the cross-validation.
    """
    if info.get("teacher"):
        return {}
    of_network = info["training"].get("held_out")
    crossed = info["accuracy"]["cross_validation"]
    return of_network if isinstance(of_network, dict) else crossed["chosen"] if crossed else {}


def score(info: Mapping[str, Any]) -> str:
    """Return the score in a line, or why there is none."""
    if teacher := info.get("teacher"):
        return (
            f"not scored     its labels are answers of {teacher['name']}; only labels of your own "
            "tell how right it is"
        )
    row = held_out(info)
    if not row and info.get("sureness"):
        counts = Calibration.from_dict(info["sureness"])
        share = _percent(counts.accuracy(counts.right))
        return f"measured       {share} of points right, on ground it had not seen"
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
    """Return the word for the groups that a dimension numbers."""
    return "files" if dimension == FILE_NUMBER else dimension


def _percent(value: Any) -> str:
    return f"{100 * value:.1f} %" if isinstance(value, float) else "-"
