"""Rules of consistency: against a slow reference, and what must hold whatever the points."""

from __future__ import annotations

from collections import Counter, defaultdict
from itertools import product

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages.base.errors import DimensionError, OptionError
from pdal_stages.cli import main
from pdal_stages.objects import consistency
from pdal_stages.objects.consistency import RULES, consistent
from pdal_stages.pipeline.classify_request import ClassifyRequest
from pdal_stages.stages.consistency import Consistency


def scene(seed=0, side=40, density=12):
    """A house with a leaning roof and walls, a bank, a tree, and classes with faults: xyz, codes, height, ground, truth."""
    rng = np.random.default_rng(seed)
    n = side * side * density
    x, y = rng.uniform(0, side, (2, n))
    z, truth = rng.normal(0, 0.02, n), np.full(n, 2)
    roof = (np.abs(x - 10) < 6) & (np.abs(y - 10) < 6)
    z[roof], truth[roof] = 6 + 0.4 * x[roof] + rng.normal(0, 0.02, roof.sum()), 6
    tree = np.hypot(x - 28, y - 28) < 4
    z[tree], truth[tree] = rng.uniform(2, 9, tree.sum()), 5
    k = 1500
    wall = np.column_stack(
        [rng.uniform(4, 16, k), 4 + rng.normal(0, 0.02, k), rng.uniform(0.3, 8, k)]
    )
    xyz = np.round(np.vstack([np.column_stack([x, y, z]), wall]), 3)
    truth = np.r_[truth, np.full(k, 6)].astype(np.uint8)
    height, ground = xyz[:, 2].copy(), (truth == 2).astype(np.uint8)
    codes, flip = truth.copy(), rng.random(len(truth))
    codes[(truth == 6) & (flip < 0.03)] = 5  # on the roof, and on the wall
    codes[(truth == 5) & (flip < 0.02)] = 6
    bank = (truth == 2) & (xyz[:, 0] > 28) & (xyz[:, 1] < 15)
    codes[bank & (flip < 0.5)] = 6
    codes[(truth == 6) & (height > 6) & (flip > 0.98)] = 2
    return xyz, codes, height, ground, truth


# ---- a slow reference -----------------------------------------------------------------------------------

KIND = {2: "g", 3: "v", 4: "v", 5: "v", 6: "b"}


def slow(xyz, codes, height, ground, rules=RULES):
    cell = np.floor(xyz).astype(int)
    members = defaultdict(list)
    for p, at in enumerate(map(tuple, cell)):
        members[at].append(p)
    kind = np.array([KIND.get(c, "o") for c in codes])

    def near(p):
        return [
            q for d in product((-1, 0, 1), repeat=3) for q in members.get(tuple(cell[p] + d), ())
        ]

    counts = {}
    for rule in RULES:
        if rule not in rules:
            continue
        new = kind.copy()
        built, up = kind == "b", ground == 0
        low, tall = built & ~up & (height < 0.3), built & up & (height > 2)
        more = Counter(map(tuple, cell[low, :2]))
        more.subtract(map(tuple, cell[tall, :2]))
        for p in range(len(xyz)):
            if rule == "ground" and low[p]:
                near_by = sum(more[tuple(cell[p, :2] + d)] for d in product(range(-2, 3), repeat=2))
                new[p] = "g" if near_by > 0 else "b"
            if rule == "islands" and kind[p] == "g" and not ground[p] and height[p] > 2:
                around = kind[near(p)]
                v, b = (around == "v").sum(), (around == "b").sum()
                if v + b:
                    new[p] = "b" if b >= v else "v"
            if rule == "lone" and kind[p] in "vb":
                around = kind[near(p)]
                for other in "vb".replace(kind[p], ""):
                    if (
                        len(around) > consistency.ENOUGH
                        and (around == kind[p]).sum() == 1
                        and (around == other).sum() >= consistency.SHARE * len(around)
                    ):
                        new[p] = other
        counts[rule] = int((new != kind).sum())
        kind = new

    def vegetation(p):
        around = codes[near(p)]
        return max((5, 4, 3), key=lambda code: np.count_nonzero(around == code))

    code = {"g": lambda p: 2, "v": vegetation, "b": lambda p: 6}
    same = np.array([KIND.get(c, "o") for c in codes]) == kind
    return np.array([codes[p] if same[p] else code[k](p) for p, k in enumerate(kind)]), counts


@pytest.mark.parametrize("seed", [0])
def test_the_kernels_equal_the_slow_reference(seed):
    xyz, codes, height, ground, _ = scene(seed, 36, 6)
    codes[::97] = 9
    codes[(codes == 5) & (xyz[:, 2] < 4)] = 4
    found, figures = consistent(xyz, codes, height=height, ground=ground)
    want, counts = slow(xyz, codes, height, ground)
    assert np.array_equal(found, want)
    assert figures == counts and all(counts[rule] for rule in RULES if rule != "lone")


# ---- what must hold -------------------------------------------------------------------------------------


def test_faults_are_mended():
    xyz, codes, height, ground, truth = scene(4)
    before, after = codes != truth, consistent(xyz, codes, height=height, ground=ground)[0] != truth
    assert after.sum() < 0.3 * before.sum()
    bank = (xyz[:, 0] > 28) & (xyz[:, 1] < 15)
    assert before[bank].sum() > 300 and not after[bank].any()


@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 1000), steps=st.tuples(*[st.integers(-5000, 5000)] * 3))
def test_order_and_shifts_change_nothing(seed, steps):
    xyz, codes, height, ground, _ = scene(seed, 36, 5)
    xyz = np.round(xyz * 64) / 64  # so that a shift rounds nothing
    found, _ = consistent(xyz, codes, height=height, ground=ground)
    order = np.random.default_rng(seed).permutation(len(xyz))
    again, _ = consistent(xyz[order], codes[order], height=height[order], ground=ground[order])
    assert np.array_equal(again, found[order])
    moved, _ = consistent(xyz + np.array(steps), codes, height=height, ground=ground)
    assert np.array_equal(moved, found)


@pytest.mark.parametrize("rules", [tuple(RULES), ["lone"]])
def test_a_tile_with_its_surroundings_gets_what_the_whole_gets(rules):
    xyz, codes, height, ground, _ = scene(6, 60, 8)
    found, _ = consistent(xyz, codes, height=height, ground=ground, rules=rules)
    for x0, y0 in ((5.3, 3.1), (20, 10), (28.5, 0), (23, 31.2), (12.5, 33.5)):
        beyond = np.max([[x0, y0] - xyz[:, :2], xyz[:, :2] - [x0 + 8, y0 + 8]], axis=(0, 2))
        inside, near = beyond < 0, beyond < consistency.reach(rules)
        part, _ = consistent(
            xyz[near], codes[near], height=height[near], ground=ground[near], rules=rules
        )
        assert np.array_equal(part[inside[near]], found[inside])


def test_only_what_may_be_changed_is():
    xyz, codes, height, ground, _ = scene(7)
    change = np.random.default_rng(0).random(len(codes)) < 0.5
    found, _ = consistent(xyz, codes, height=height, ground=ground, change=change)
    assert np.array_equal(found[~change], codes[~change]) and (found != codes).any()
    left_out, _ = consistent(xyz, codes, height=height, ground=ground, mask=change)
    assert np.array_equal(left_out[~change], codes[~change])
    assert not len(consistent(np.empty((0, 3)), np.empty(0, np.uint8))[0])


# ---- the stage ------------------------------------------------------------------------------------------


def arrays_of(seed=8, **size):
    xyz, codes, height, ground, truth = scene(seed, **size)
    arrays = {
        "X": xyz[:, 0],
        "Y": xyz[:, 1],
        "Z": xyz[:, 2],
        "Classification": codes.astype(np.uint8),
    }
    return {**arrays, "HeightAboveGround": height, "Ground": ground}, truth


def test_the_stage_counts_by_rule_and_says_what_it_lacks():
    arrays, truth = arrays_of()
    stage = Consistency({"lone": False})
    points = stage.points(arrays)
    codes = stage.run(points)["Classification"]
    figures = points.report.figures
    assert figures["ground"] > 100 and figures["islands"] > 10 and "lone" not in figures
    assert figures["changed"] == (codes != arrays["Classification"]).sum()
    assert figures["classes"] == {str(c): int((codes == c).sum()) for c in (2, 5, 6)}
    assert (codes != truth).sum() < (arrays["Classification"] != truth).sum()
    bare = Consistency({}).points(
        {k: v for k, v in arrays.items() if k in ("X", "Y", "Z", "Classification")}
    )
    Consistency({}).run(bare)
    assert bare.report.figures["ground"] == 0 and "no HeightAboveGround" in bare.report.warnings[0]


def test_overlap_noise_and_where_keep_their_class():
    arrays, _ = arrays_of()
    codes = arrays["Classification"].copy()
    codes[:100], codes[100:200] = 12, 7
    stage = Consistency({"where": "X > 10"})
    out = stage.run(stage.points({**arrays, "Classification": codes}))["Classification"]
    left = (codes == 12) | (codes == 7) | (arrays["X"] <= 10)
    assert np.array_equal(out[left], codes[left]) and (out != codes).any()


def test_what_becomes_vegetation_has_the_class_of_its_height():
    arrays, _ = arrays_of()
    # Leaves below 0.5 m as well.
    arrays["HeightAboveGround"] = np.where(arrays["Z"] < 5, arrays["Z"] / 8, arrays["Z"])
    plain = Consistency({})
    high = plain.run(plain.points(arrays))["Classification"]
    stage = Consistency({"vegetation_heights": "0.5,2"})
    split = stage.run(stage.points(arrays))["Classification"]
    made, height = (high == 5) & (arrays["Classification"] != 5), arrays["HeightAboveGround"]
    expected = high.copy()
    expected[made & (height < 2)] = 4
    expected[made & (height < 0.5)] = 3
    assert len(np.unique(expected[made])) > 1 and np.array_equal(split, expected)


def test_heights_of_vegetation_that_mean_nothing():
    for wrong in ("2", "2,0.5", "a,b"):
        with pytest.raises(OptionError, match="vegetation_heights"):
            Consistency({"vegetation_heights": wrong})
    arrays, _ = arrays_of()
    del arrays["HeightAboveGround"]
    stage = Consistency({"vegetation_heights": "0.5,2", "ground": False, "islands": False})
    with pytest.raises(DimensionError, match="HeightAboveGround"):
        stage.run(stage.points(arrays))


@pytest.mark.pdal
def test_three_classes_of_vegetation_in_one_command(tmp_path):
    """The rules at the end take them as well."""
    words = ["--vegetation-heights", "0.5,2"]
    arrays, _ = arrays_of(side=33)
    source = write_file(tmp_path / "in.las", arrays)
    jobs = {"plain": [], "whole": words}
    for name, more in jobs.items():
        out = str(tmp_path / f"{name}.las")
        assert main(["classify", source, out, "--dimensions", "HeightAboveGround", *more]) == 0
    plain, whole = (laspy.read(tmp_path / f"{name}.las") for name in jobs)
    height, codes = np.asarray(whole.HeightAboveGround), np.asarray(whole.classification)
    assert np.array_equal(np.isin(codes, (3, 4, 5)), np.asarray(plain.classification) == 5)
    assert (height[codes == 3] <= 0.5).all() and (
        height[codes == 5] >= 2
    ).all()  # heights are written rounded
    assert ((height[codes == 4] >= 0.5) & (height[codes == 4] <= 2)).all() and (
        codes == 5
    ).sum() > 500


def write_file(path, arrays):
    las = laspy.create(point_format=6, file_version="1.4")
    las.header.scales = [0.001] * 3
    las.x, las.y, las.z = arrays["X"], arrays["Y"], arrays["Z"]
    las.write(path)
    return str(path)


@pytest.mark.parametrize("consistency", [True, False])
def test_classify_mends_at_the_end_unless_told_not_to(consistency):
    stages = ClassifyRequest(consistency=consistency).stages
    assert (stages[-1]["type"] == "filters.consistency") == consistency
