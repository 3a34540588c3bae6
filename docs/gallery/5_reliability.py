"""Where the classifier is in doubt: reliability from above, and the share of errors among doubtful
points."""

import numpy as np
from _common import halves, save, top_view, town

import pdal_stages as ps

points = town(seed=2)
west, east = halves(points)
height = np.zeros(len(points.x))
for half in (west, east):
    height[half] = ps.hag_minima(*points.xyz[half].T)
options = ps.TrainingOptions(
    neighborhoods="c1,c3,s2",
    feature_set="covariance,geometric",
    classes="2,5,6",
    count=1500,
    trees=50,
)
training = ps.TrainingCloud(
    points.xyz[west], points.classification[west], {"HeightAboveGround": height[west]}
)
model = ps.train([training], options, progress=False)
prediction = model.predict(points.xyz[east], {"HeightAboveGround": height[east]})
truth = points.classification[east]
known = np.isin(truth, (2, 5, 6))
wrong = prediction.classification != truth
for low, high in ((0.0, 0.6), (0.6, 0.8), (0.8, 0.95), (0.95, 1.01)):
    inside = known & (prediction.reliability >= low) & (prediction.reliability < high)
    print(
        f"reliability {low:.2f} to {min(high, 1):.2f}: {inside.sum():7,} points, "
        f"{100 * wrong[inside].mean():5.1f} % wrong"
    )
save(
    "5_reliability",
    top_view(*points.xyz[east].T, values=prediction.reliability, limits=(0.4, 1.0), width=900),
)
