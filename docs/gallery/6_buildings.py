"""Binary detection: buildings against everything else, in a vertical section."""

import numpy as np
from _common import halves, save, town

import pdal_stages as ps
from pdal_stages.picture import section_view

points = town(seed=3)
west, east = halves(points)
options = ps.TrainingOptions(
    neighborhoods="c1,c2,c5,s2",
    feature_set="covariance,geometric",
    strategy="binary",
    target=6,
    count=2000,
    trees=50,
)
training = ps.TrainingCloud(
    points.xyz[west],
    points.classification[west],
    {"HeightAboveGround": ps.hag_minima(*points.xyz[west].T)},
)
model = ps.train([training], options, progress=False)
xyz = points.xyz[east]
found = model.predict(xyz, {"HeightAboveGround": ps.hag_minima(*xyz.T)})
print(f"recall {np.mean(found.classification[points.classification[east] == 6] == 6):.3f}")
middle = np.median(xyz[:, 1])
section = section_view(
    *xyz.T, found.classification, start=(xyz[:, 0].min(), middle), end=(xyz[:, 0].max(), middle), thickness=6
)
save("6_buildings", section)
