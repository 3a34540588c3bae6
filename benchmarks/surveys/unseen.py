"""What a model makes of the surveys that it was not trained on.

    python benchmarks/surveys/unseen.py --data DIR --model FILE --json JSON

Every survey as it was flown and thinned to 4 and 1 points per square meter, as by leave_one_out.py.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from clouds import load, thinned
from leave_one_out import THINNED, score
from sources import check
from surveys import SURVEYS

from pdal_stages import Model, load_model


def not_trained_on(model: Model) -> list[str]:
    """The surveys of which no copy is among a model's clouds."""
    seen = {cloud["name"].split(",")[0] for cloud in model.info["training"]["clouds"]}
    return [name for name in SURVEYS if name not in seen]


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    options.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    options.add_argument("--model", type=Path, required=True, help="the model file")
    options.add_argument("--json", type=Path, required=True, help="where the figures go")
    args = options.parse_args()
    model = load_model(args.model)
    surveys = not_trained_on(model)
    check(args.data, [file for name in surveys for file in SURVEYS[name].files])
    runs = []
    for name in surveys:
        cloud = load(args.data, name)
        for one in (cloud, *(thinned(cloud, density) for density in THINNED)):
            if one is not None:
                runs.append(score(model, one))
                print(json.dumps(runs[-1]), flush=True)
    args.json.write_text(json.dumps({"surveys": runs}, indent=1) + "\n")


if __name__ == "__main__":
    main()
