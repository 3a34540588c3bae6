"""Samples: as many as asked for, spread over the class, the same whatever the order of the points."""

import numpy as np

from pdal_stages.classifier.sampling import draw_samples


def chosen(clouds, samples):
    """Coordinates, class and weight of each sample, sorted."""
    each = zip(samples.cloud, samples.row, samples.label, samples.weight, strict=True)
    return sorted((*clouds[c][0][r], int(k), int(w)) for c, r, k, w in each)


def test_counts_and_duplicates(random_cloud):
    xyz = random_cloud(1000, decimals=None)
    label = np.zeros(1000, np.int16)
    label[:30], label[30:40] = 1, -1
    samples = draw_samples([(xyz, label)], 2, 100, 7)
    assert samples.counts(0) == {"available": 960, "samples": 100, "duplicates": 0}
    assert samples.counts(1) == {"available": 30, "samples": 30, "duplicates": 70}
    small = samples.weight[samples.label == 1]
    assert small.sum() == 100 and set(small.tolist()) == {3, 4}
    rare = draw_samples([(xyz, label)], 2, 100, 7, fill_up=False)
    assert rare.counts(0) == samples.counts(0)
    assert rare.counts(1) == {"available": 30, "samples": 30, "duplicates": 0}
    assert (label[samples.row] == samples.label).all()
    assert len(set(zip(samples.cloud.tolist(), samples.row.tolist(), strict=True))) == len(samples)


def test_order_of_points_and_clouds_does_not_matter(random_cloud):
    a, b = random_cloud(800, seed=1), random_cloud(300, seed=2, origin=(20, 0, 0))
    la = np.random.default_rng(0).integers(-1, 3, 800).astype(np.int16)
    lb = np.random.default_rng(1).integers(-1, 3, 300).astype(np.int16)
    clouds = [(a, la), (b, lb)]
    first = chosen(clouds, draw_samples(clouds, 3, 50, 5))
    p, q = np.random.default_rng(2).permutation(800), np.random.default_rng(3).permutation(300)
    shuffled = [(b[q], lb[q]), (a[p], la[p])]
    assert chosen(shuffled, draw_samples(shuffled, 3, 50, 5)) == first
    assert chosen(clouds, draw_samples(clouds, 3, 50, 6)) != first
    split = [(a[:100], la[:100]), (a[100:], la[100:]), (b, lb)]
    assert chosen(split, draw_samples(split, 3, 50, 5)) == first


def test_other_classes_and_a_larger_extent_change_nothing(random_cloud):
    xyz = random_cloud(500)
    label = np.zeros(500, np.int16)
    before = chosen([(xyz, label)], draw_samples([(xyz, label)], 1, 40, 0))
    more = np.vstack([xyz, [[-4e5, 7e6, 0.0]]])
    other = np.append(label, np.int16(-1))
    assert chosen([(more, other)], draw_samples([(more, other)], 1, 40, 0)) == before


def test_spread_over_space_and_not_clumped():
    """Each of 16 equal blocks gets its share, closer than chance would; and a dense corner gets its own."""
    random = np.random.default_rng(0)
    xyz = random.random((40_000, 3)) * (100, 100, 5)
    samples = draw_samples([(xyz, np.zeros(len(xyz), np.int16))], 1, 1600, 0)
    blocks = np.floor(xyz[samples.row, :2] / 25).astype(int)
    share = np.bincount(blocks[:, 0] * 4 + blocks[:, 1], minlength=16)
    # 100 expected each; independent draws would have a standard deviation of 9.7.
    assert np.abs(share - 100).max() <= 12
    assert share.std() < 6
    # Nearest neighbors in plan are farther apart than those of random draws.
    from scipy.spatial import cKDTree

    def nearest(points):
        return np.median(cKDTree(points).query(points, k=2)[0][:, 1])

    drawn = random.choice(len(xyz), 1600, replace=False)
    assert nearest(xyz[samples.row, :2]) > 1.1 * nearest(xyz[drawn, :2])
