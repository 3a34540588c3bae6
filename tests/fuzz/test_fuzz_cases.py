"""Earlier findings, and a short run of random changes to good inputs.

``PDAL_STAGES_FUZZ_SECONDS=600 python -m pytest tests/fuzz -k cloud`` changes inputs for so long.
"""

from __future__ import annotations

import os
import random
import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent))
from targets import TARGETS

CASES = sorted(
    path for path in (Path(__file__).resolve().parent / "cases").rglob("*") if path.is_file()
)
#: Changed inputs that are tried for each target, or seconds of them.
TRIES = {"pipeline": 300, "model": 60, "cloud": 200, "ept": 200, "network": 25}
SECONDS = float(os.environ.get("PDAL_STAGES_FUZZ_SECONDS", 0))
#: CPU seconds one input may take; beyond it is a finding.
PATIENCE = 10.0
WORDS = [b"null", b"-1", b"1e999", b'"', b"[", b"}", b",", b"/*", b"\\u0000", b"\\ud800", b"\xff", b"kopt(9,2)", b"NaN",
         b"0", b'"inputs":5,']  # fmt: skip


@pytest.mark.parametrize("path", CASES, ids=[f"{p.parent.name}-{p.name}" for p in CASES])
def test_findings_stay_fixed(path):
    assert TARGETS[path.parent.name][0](path.read_bytes())


def change(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """One to five random changes: bytes, words, pieces cut out, doubled or taken from another
    input."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 5)):
        at, to = sorted(rng.randrange(len(out) + 1) for _ in range(2))
        to = min(to, at + 40)
        kind = rng.randrange(6)
        if kind == 0 and out:
            out[at % len(out)] ^= 1 << rng.randrange(8)
        elif kind == 1:
            out[at:at] = rng.choice(WORDS)
        elif kind == 2:
            del out[at:to]
        elif kind == 3:
            out[at:at] = out[at:to]
        elif kind == 4:
            other = rng.choice(others)
            start = rng.randrange(len(other))
            out[at:to] = other[start : start + rng.randint(1, 60)]
        else:
            out[at:to] = rng.choice(WORDS)
    return bytes(out)


@pytest.mark.timeout(SECONDS + 600)
@pytest.mark.parametrize("name", sorted(TARGETS))
def test_changed_inputs_are_refused_or_right(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call, seeds = TARGETS[name][0], TARGETS[name][1]()
    rng = random.Random(time.time_ns() if SECONDS else 7)
    seen = {call(seed) for seed in seeds}
    tried, until = 0, time.monotonic() + SECONDS
    while time.monotonic() < until if SECONDS else tried < TRIES[name]:
        data, started = change(rng.choice(seeds), rng, seeds), time.process_time()
        tried += 1
        try:
            seen.add(call(data))
            assert time.process_time() - started < PATIENCE, "too slow"
        except BaseException:
            (tmp_path / "finding").write_bytes(data)  # pytest keeps the folder
            raise
    print(f"{name}: {tried:,} changed inputs")
    assert len(seen) == 2  # both ways were taken
    assert not list(tmp_path.iterdir())  # parsing writes nothing
