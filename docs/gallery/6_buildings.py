"""Binary detection: buildings against everything else, learned in one town, found in another."""

import numpy as np
from _common import save, top_view, town

import pdal_stages as ps


def with_height(points):
    return {"HeightAboveGround": ps.hag_minima(points.x, points.y, points.z)}


learned, other = town(seed=3), town(seed=4)
options = ps.TrainingOptions(
    neighborhoods="c1,c2,c5,s2",
    feature_set="covariance,geometric",
    target=6,
    count=3000,
    trees=50,
)
model = ps.train(
    [ps.TrainingCloud(learned.xyz, learned.classification, with_height(learned))],
    options,
    progress=False,
)
predicted = model.predict(other.xyz, with_height(other)).classification == 6
true = other.classification == 6
print(f"recall {np.mean(predicted[true]):.3f}, precision {np.mean(true[predicted]):.3f}")
save("6_buildings", top_view(other.x, other.y, other.z, np.where(predicted, 6, 1)))
