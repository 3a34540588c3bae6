"""A line of history for each benchmark run worth keeping, and the table docs/benchmark-history.md made of them.

    python benchmarks/features.py --cloud town --json features.json
    python benchmarks/real_clouds.py --data FOLDER --json real.json
    python benchmarks/history.py --features features.json --real real.json --note "what changed"
    python benchmarks/history.py                                    # only write the table again

Times of one machine may be compared, and ratios to pgeof of any two: those are what the table shows.
"""

from __future__ import annotations

import argparse
import datetime
import json
import statistics
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LINES = ROOT / "benchmarks" / "history.jsonl"
TABLE = ROOT / "docs" / "benchmark-history.md"
CASES = {"moments": "12 features of eight", "kopt": "kopt", "shapes": "shapes of eight", "all": "all 560"}


def entry(features: Path | None, real: Path | None, note: str) -> dict:
    """One line: when, what, where, and the figures."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    out: dict = {"date": datetime.date.today().isoformat(), "commit": commit.stdout.strip(), "note": note}
    if features:
        data = json.loads(features.read_text())
        out["machine"], out["versions"] = data["machine"], data["versions"]
        out["town"] = {}
        for case in data["clouds"]["town"]:
            cpu = statistics.median(c for c, _ in case["ours"])
            row = {"cpu": round(cpu, 2)}
            if case["peers"].get("pgeof"):
                row["pgeof"] = round(statistics.median(c for c, _ in case["peers"]["pgeof"]) / cpu, 1)
            out["town"][case["case"]] = row
    if real:
        keep = ("overall_accuracy", "kappa", "mean_f1")
        data = json.loads(real.read_text())
        out["real"] = {
            scene: {name: round(100 * row[name], 2) for name in keep}
            for scene, row in data.items()
            if isinstance(row, dict) and "overall_accuracy" in row
        }
    return out


def table(lines: list[dict]) -> str:
    """The history as a page, the latest first."""
    head = ["date", "commit", "what changed", *(f"{what}, CPU s (pgeof ×)" for what in CASES.values())]
    head += ["Montpellier OA / mean F1", "Delft OA / mean F1", "machine"]
    rows = []
    for line in reversed(lines):
        cells = [line["date"], line["commit"], line["note"]]
        for case in CASES:
            row = line.get("town", {}).get(case)
            cells.append(
                "" if row is None else f"{row['cpu']}" + (f" ({row['pgeof']})" if "pgeof" in row else "")
            )
        for scene in ("montpellier", "delft"):
            row = line.get("real", {}).get(scene)
            cells.append("" if row is None else f"{row['overall_accuracy']:.1f} / {row['mean_f1']:.1f}")
        rows.append([*cells, line.get("machine", "")])
    text = [
        "# Benchmark history",
        "",
        "Written by `python benchmarks/history.py` from `benchmarks/history.jsonl`. Features: a generated town of half a",
        "million points. Real clouds: test parts, all defaults of that commit.",
        "",
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
        *("| " + " | ".join(row) + " |" for row in rows),
    ]
    return "\n".join(text) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--features", type=Path, help="what features.py --json wrote")
    parser.add_argument("--real", type=Path, help="what real_clouds.py --json wrote")
    parser.add_argument("--note", default="", help="what changed")
    options = parser.parse_args()
    if options.features or options.real:
        if not options.note:
            parser.error("say what changed: --note TEXT")
        with LINES.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry(options.features, options.real, options.note)) + "\n")
    lines = [json.loads(line) for line in LINES.read_text(encoding="utf-8").splitlines()]
    TABLE.write_text(table(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
