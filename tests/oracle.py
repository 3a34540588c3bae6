"""Slow, obvious reference of every neighborhood and feature, straight from the definitions.

NumPy only, one query at a time, every point of the cloud looked at. Squared distances are
``(x - qx)**2 + (y - qy)**2 + (z - qz)**2`` from float64 differences, which is what makes members well defined.
"""

from __future__ import annotations

import math

import numpy as np

COVARIANCE = (
    "Linearity",
    "Planarity",
    "Scattering",
    "Omnivariance",
    "Anisotropy",
    "Eigenentropy",
    "EigenvalueSum",
    "SurfaceVariation",
)
GEOMETRIC = ("Density", "Verticality", "HeightRange", "HeightStd", "HeightAboveLowest")
METRICS = ("A3", "D1", "D2", "D3", "D4")

# ---- members -----------------------------------------------------------------------------------------------


def squared_distance(xyz, q, flat=False):
    """Squared distances of all points from q, in the plane where `flat`."""
    dx, dy, dz = (xyz - q).T
    return dx * dx + dy * dy if flat else dx * dx + dy * dy + dz * dz


def cylinder(xyz, q, radius):
    """Members of the vertical cylinder of infinite height round q."""
    return xyz[squared_distance(xyz, q, flat=True) <= radius * radius]


def sphere(xyz, q, radius):
    """Members of the sphere round q."""
    return xyz[squared_distance(xyz, q) <= radius * radius]


def by_distance(xyz, q):
    """All points in the order of (squared distance, x, y, z), and their distances."""
    d2 = squared_distance(xyz, q)
    order = np.lexsort((xyz[:, 2], xyz[:, 1], xyz[:, 0], d2))
    return xyz[order], np.sqrt(d2[order])


def nearest(xyz, q, k):
    """The point and its k nearest (k + 1 members), and the distance to the farthest of them."""
    points, distance = by_distance(xyz, q)
    return points[: k + 1], float(distance[: k + 1][-1])


# ---- features of a set of members --------------------------------------------------------------------------


def covariance(members):
    """Covariance matrix, divisor n."""
    offsets = members - members[0]
    offsets = offsets - offsets.mean(axis=0)
    return offsets.T @ offsets / len(members)


def eigen(members):
    """Eigenvalues l1 >= l2 >= l3 >= 0, and the eigenvectors as columns in the same order."""
    values, vectors = np.linalg.eigh(covariance(members))
    return np.maximum(values[::-1], 0.0), vectors[:, ::-1]


def entropy(members):
    """Eigenentropy; infinite where there are fewer than three members or all coincide."""
    if len(members) < 3 or (members == members[0]).all():
        return math.inf
    l = eigen(members)[0]
    e = l / l.sum()
    return float(-sum(v * math.log(v) for v in e if v > 0.0))


def features(members, volume, q):
    """The features made of moments; `volume` is what Density divides by, `q` the query."""
    if not len(members):
        out = dict.fromkeys((*COVARIANCE, *GEOMETRIC), 0.0)
        return {**out, "SurfaceVariation": 1.0 / 3.0}
    z = members[:, 2] - members[0, 2]
    out = {
        "Density": len(members) / volume if volume else 0.0,
        "HeightRange": z.max() - z.min(),
        "HeightStd": z.std(),
        "HeightAboveLowest": q[2] - members[:, 2].min(),
    }
    if len(members) < 3 or (members == members[0]).all():
        return {
            **dict.fromkeys((*COVARIANCE, "Verticality"), 0.0),
            "SurfaceVariation": 1.0 / 3.0,
            **out,
        }
    l, vectors = eigen(members)
    e1, e2, e3 = l / l.sum()
    normal = abs(vectors[2, 2])
    if l[1] <= 1e-12 * l[0]:  # a line: its steepest perpendicular
        normal = math.sqrt(max(0.0, 1.0 - vectors[2, 0] ** 2))
    return {
        "Linearity": (e1 - e2) / e1,
        "Planarity": (e2 - e3) / e1,
        "Scattering": e3 / e1,
        "Omnivariance": np.cbrt(e1 * e2 * e3),
        "Anisotropy": (e1 - e3) / e1,
        "Eigenentropy": -sum(v * math.log(v) for v in (e1, e2, e3) if v > 0.0),
        "EigenvalueSum": l.sum(),
        "SurfaceVariation": e3,
        "Verticality": 1.0 - normal,
        **out,
    }


def normal_gap(members):
    """(l2 - l3) / l1: how well the normal is defined, 0 where it is not."""
    l = eigen(members)[0]
    return float((l[1] - l[2]) / l[0]) if l[0] > 0.0 else 0.0


SURFACES = ("NormalAgreement", "SurfaceVariationMin", "SurfaceVariationMean", "SurfaceVariationStd")
AROUND = 10  # neighbors that make a point's surface


def surface(xyz, q):
    """Normal (zeros for none) and surface variation of q's 10 nearest, and how well the normal is defined."""
    members, _ = nearest(xyz, q, AROUND)
    if len(members) < 3 or (members == members[0]).all():
        return np.zeros(3), 1.0 / 3.0, 1.0
    l, vectors = eigen(members)
    normal = vectors[:, 2]
    if (
        l[1] <= 1e-12 * l[0]
    ):  # a line: its steepest perpendicular, that to the north of a vertical one left open
        along = vectors[:, 0]
        normal = np.array([0.0, 0.0, 1.0]) - along[2] * along
        length = np.linalg.norm(normal)
        return (
            (normal / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])),
            float(l[2] / l.sum()),
            1.0,
        )
    return normal, float(l[2] / l.sum()), normal_gap(members)


def surfaces(xyz, q, k):
    """Return what the surfaces of q and its k nearest make of it, and how well the worst of their normals is defined."""
    own_surface, _, gap = surface(xyz, q)
    surfaces_near = [surface(xyz, p) for p in nearest(xyz, q, k)[0]]
    variation = np.array([v for _, v, _ in surfaces_near])
    values = (
        float(np.mean([abs(own_surface @ normal) for normal, _, _ in surfaces_near])),
        float(variation.min()),
        float(variation.mean()),
        float(variation.std()),
    )
    return dict(zip(SURFACES, values, strict=True)), min(gap, *(g for _, _, g in surfaces_near))


def of_sphere(xyz, q, radius):
    """Features of a sphere."""
    return features(sphere(xyz, q, radius), 4.0 / 3.0 * math.pi * radius**3, q)


def ball_volume(radius):
    return 4.0 / 3.0 * math.pi * radius**3


# ---- adaptive neighborhoods --------------------------------------------------------------------------------

TIE = 1e-9  # entropies closer than this are equal, and the smallest neighborhood wins


def _first_lowest(entropies):
    """Index of the first entropy within TIE of the lowest; the last one where none is finite."""
    lowest = min(entropies)
    if math.isinf(lowest):
        return len(entropies) - 1
    return next(i for i, value in enumerate(entropies) if value <= lowest + TIE)


def kopt(xyz, q, k_min=10, k_max=100, cap=math.inf):
    """Members, radius and all entropies of the k in k_min..k_max with the lowest eigenentropy [B16].

    k counts neighbors besides the point itself. A neighborhood holds nothing beyond `cap` meters; where fewer
    than k_min lie within it, all that do are taken.
    """
    points, distance = by_distance(xyz, q)
    n = int(np.count_nonzero(squared_distance(points, q) <= cap * cap))
    sizes = list(range(min(k_min + 1, n), min(k_max + 1, n) + 1))
    entropies = [entropy(points[:size]) for size in sizes]
    size = sizes[_first_lowest(entropies)]
    return points[:size], float(distance[size - 1]), entropies


def curvature(xyz, q, radius=1.0, least=10):
    """Surface variation at `radius`, 1/3 where there are fewer than `least` points [H17 eq. 1]."""
    if len(sphere(xyz, q, radius)) < least:
        return 1 / 3
    return of_sphere(xyz, q, radius)["SurfaceVariation"]


def copt_threshold(curvatures):
    """Two-means of curvatures started at minimum and maximum, and c_t = cur1 + (cur2 - cur1) n2 / n [H17 eq. 2-3]."""
    c = np.asarray(curvatures, float)
    low, high = c.min(), c.max()
    for _ in range(1000):
        upper = abs(c - high) < abs(c - low)
        if not upper.any() or upper.all():
            break
        new = c[~upper].mean(), c[upper].mean()
        if new == (low, high):
            break
        low, high = new
    upper = abs(c - high) < abs(c - low)
    return float(low + (high - low) * np.count_nonzero(upper) / len(c))


# ---- shape distributions -----------------------------------------------------------------------------------


def shape_metrics(a, b, c, d, centroid):
    """A3, D1, D2, D3, D4 of four pulled points, in radians and meters [B16 3.2.2]."""
    a, b, c, d = (np.asarray(v, float) for v in (a, b, c, d))
    u, v, w = b - a, c - a, d - a
    lengths = np.linalg.norm(u) * np.linalg.norm(v)
    angle = math.acos(np.clip(u @ v / lengths, -1.0, 1.0)) if lengths > 0.0 else 0.0
    normal = np.cross(u, v)
    return {
        "A3": angle,
        "D1": float(np.linalg.norm(a - centroid)),
        "D2": float(np.linalg.norm(u)),
        "D3": math.sqrt(np.linalg.norm(normal) / 2.0),
        "D4": float(np.cbrt(abs(normal @ w) / 6.0)),
    }


def shape_counts(values, thresholds):
    """Share of the values in each of ten bins: bin i has thresholds[i - 1] < value <= thresholds[i]."""
    at = np.searchsorted(thresholds, values, side="left")
    return np.bincount(at, minlength=len(thresholds) + 1) / len(values)
