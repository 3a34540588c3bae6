"""Three features of one neighborhood: what lines, planes and walls look like to the classifier."""

import numpy as np
from _common import save, top_view, town

import pdal_stages as ps

points = town()
table = ps.compute_features(
    points.xyz, neighborhoods="s2", feature_set="Linearity,Planarity,Verticality"
)
views = [
    top_view(points.x, points.y, points.z, values=table[f"{name}_s2"], width=560)
    for name in ("Linearity", "Planarity", "Verticality")
]
save("2_features", np.concatenate(views, axis=1))
