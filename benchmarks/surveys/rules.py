"""What the rules of ``classify`` do to each survey: noise, bridges, and the named rules of consistency.

    python benchmarks/surveys/rules.py --data DIR --models MODELS --json FILE

Every survey as it was published, all its points, classified by the model that has not seen it (MODELS is what
``leave_one_out.py --save`` filled): noise is marked, decks are found with the heights, and the rules come last, as in
``classify``. Shares are of all points. Of the labeled points that the rules of consistency changed it is counted how
many were wrong before, and how many are now.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from clouds import published, slug, true_classes
from surveys import SHIPPED, SURVEYS

from pdal_stages import Model, detached_noise, filtered_ground, load_model
from pdal_stages.base.las import BRIDGE
from pdal_stages.objects.consistency import RULES, consistent

#: Codes of labels for which a deck found is none: ground, vegetation, building, water.
NO_DECK = (2, 3, 4, 5, 6, 9)


def count(data: Path, survey: str, model: Model) -> dict[str, Any]:
    """Points of a survey, and how many of them each rule changes."""
    known = SURVEYS[survey]
    xyz, label, returns = published(data, known)
    noise = detached_noise(xyz)
    seen = noise == 0
    made = filtered_ground(*xyz.T, mask=seen, openings=(5, 17), decks=True)
    said = model.predict(xyz, {**returns, **made}, ignore=~seen)
    codes = said.classification
    codes[~seen] = noise[~seen]
    deck = (made["Deck"] != 0) & seen
    codes[deck] = BRIDGE
    after, changed = consistent(
        xyz, codes, height=made["HeightAboveGround"], ground=made["Ground"], mask=seen
    )
    truth = true_classes(known, xyz[:, 0], xyz[:, 1], label, made["HeightAboveGround"])
    known_class = (truth > 0) & seen & ~deck
    judged = known_class & (after != codes)
    return {
        "survey": survey,
        "points": len(xyz),
        "noise": int(np.count_nonzero(~seen)),
        "noise_labeled_good": int(np.count_nonzero(~seen & (truth > 0))),
        "decks": int(np.count_nonzero(deck)),
        "decks_labeled_other": int(np.count_nonzero(deck & np.isin(label, NO_DECK))),
        "changed": {rule: int(changed[rule]) for rule in RULES},
        "labeled": int(np.count_nonzero(known_class)),
        "judged": int(np.count_nonzero(judged)),
        "wrong_before": int(np.count_nonzero(judged & (codes != truth))),
        "wrong_after": int(np.count_nonzero(judged & (after != truth))),
    }


def table(runs: list[dict[str, Any]]) -> str:
    """As Markdown."""
    rules = list(runs[0]["changed"])  # those that there were when it was measured
    lines = [
        f"| survey | points | noise | decks | {' | '.join(rules)} | labeled and changed | wrong before | after | OA |",
        f"|---|---:|---:|---:|{'---:|' * len(rules)}---:|---:|---:|---:|",
    ]
    for run in runs:
        counts = [run["noise"], run["decks"], *(run["changed"][rule] for rule in rules)]
        shares = " | ".join(_share(n, run["points"]) for n in counts)
        rest = f"{run['judged']:,} | {run['wrong_before']:,} | {run['wrong_after']:,}"
        gained = 100 * (run["wrong_before"] - run["wrong_after"]) / run["labeled"]
        rest += f" | {gained:+.2f}" if run["judged"] else " | –"
        lines.append(f"| {run['survey']} | {run['points']:,} | {shares} | {rest} |")
    return "\n".join(lines)


def _share(n: int, points: int) -> str:
    if n == 0:
        return "–"
    percent = 100 * n / points
    return f"{percent:.3f} %" if percent >= 0.001 else "< 0.001 %"


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    options.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    options.add_argument(
        "--models", type=Path, required=True, help="folder of the models, each without one survey"
    )
    options.add_argument("--json", type=Path, required=True, help="where the figures go")
    options.add_argument("--surveys", nargs="+", default=SHIPPED, choices=list(SURVEYS))
    args = options.parse_args()
    runs = []
    for survey in args.surveys:
        model = load_model(args.models / f"{slug(survey)}.model")
        runs.append(count(args.data, survey, model))
        print(json.dumps(runs[-1]), flush=True)
    print(table(runs))
    args.json.write_text(json.dumps(runs, indent=1) + "\n")


if __name__ == "__main__":
    main()
