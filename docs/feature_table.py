"""The table of features in docs/features.md, from the registry.

python docs/feature_table.py        # prints it
"""

from __future__ import annotations

from pdal_stages.features.registry import FEATURES, SHAPE_BINS, SHAPES


def table() -> str:
    """Return a row for each feature, and one for the bins of each shape distribution."""
    lines = ["| feature | group | unit | definition |", "|---|---|---|---|"]
    for feature in FEATURES:
        metric, _, number = feature.name.partition("_")
        if feature.group != "shapes":
            name, definition = f"`{feature.name}`", feature.definition
        elif number == "0":
            name = f"`{metric}_0` … `{metric}_{SHAPE_BINS - 1}`"
            definition = f"histogram: {SHAPES[metric]} [B16 3.2.2]"
        else:
            continue
        lines.append(f"| {name} | {feature.group} | {feature.unit} | {definition} |")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    print(table(), end="")
