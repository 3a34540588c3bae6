"""Train a shipped model from the open clouds; the same code gives the same bits every time.

python benchmarks/surveys/build.py --data DIR --out pdal_stages/models/standard.model
"""

from __future__ import annotations

import argparse
import hashlib
import json
import time
from pathlib import Path

from clouds import load_test
from leave_one_out import score
from recipe import train_on
from sources import check
from surveys import SURVEYS, TESTS


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    options.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    options.add_argument("--out", type=Path, required=True, help="the model file")
    options.add_argument("--surveys", nargs="+", default=list(SURVEYS), choices=list(SURVEYS))
    options.add_argument("--tests", type=Path, help="where scores of the test parts go, as JSON")
    args = options.parse_args()
    check(args.data, [file for name in args.surveys for file in SURVEYS[name].files])
    started = time.process_time()
    model = train_on(args.data, args.surveys)
    model.save(args.out)
    print(model)
    digest = hashlib.sha256(args.out.read_bytes()).hexdigest()
    size = args.out.stat().st_size / 1e6
    print(
        f"{args.out}: {size:.2f} MB, sha256 {digest[:16]}, "
        f"{time.process_time() - started:.0f} CPU s"
    )
    if args.tests:
        scores = []
        for cloud in (load_test(args.data, name) for name in TESTS):
            classes = model.predict(cloud.xyz, cloud.dimensions).classification
            scores.append(score(classes, cloud))
        args.tests.write_text(json.dumps(scores, indent=1) + "\n")


if __name__ == "__main__":
    main()
