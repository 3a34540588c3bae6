"""Train on the western half, classify the eastern one, show where it is wrong."""

from _common import halves, save, town

import pdal_stages as ps
from pdal_stages.reports.pictures import triptych

points = town()
west, east = halves(points)


def cloud(mask):
    xyz = points.xyz[mask]
    return xyz, {"HeightAboveGround": ps.hag_minima(*xyz.T)}


xyz, dimensions = cloud(west)
options = ps.TrainingOptions(
    neighborhoods="c1,c2,c5,s1,kopt",
    feature_set="covariance,geometric",
    dimensions=("HeightAboveGround",),
    classes={"2": 2, "3,4,5": "5 Vegetation", "6": 6},
    count=2000,
    trees=50,
)
model = ps.train(
    [ps.TrainingCloud(xyz, points.classification[west], dimensions)], options, progress=False
)
xyz, dimensions = cloud(east)
prediction = model.predict(xyz, dimensions, margin=True)
truth = points.classification[east].copy()
truth[(truth == 3) | (truth == 4)] = 5
known = (truth == 2) | (truth == 5) | (truth == 6)
print(ps.Accuracy.from_labels(truth[known], prediction.classification[known]).table())
save(
    "4_train_and_classify", triptych(*xyz[known].T, prediction.classification[known], truth[known])
)
