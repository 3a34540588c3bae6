"""One feature at three scales: SurfaceVariation in cylinders of 1, 2 and 5 m."""

import numpy as np
from _common import save, top_view, town

import pdal_stages as ps

points = town()
table = ps.compute_features(points.xyz, neighborhoods="c1,c2,c5", feature_set="SurfaceVariation")
views = [
    top_view(
        points.x,
        points.y,
        points.z,
        values=table[f"SurfaceVariation_{token}"],
        limits=(0, 0.2),
        width=560,
    )
    for token in ("c1", "c2", "c5")
]
save("3_scales", np.concatenate(views, axis=1))
