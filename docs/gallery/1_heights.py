"""Heights above the coarse terrain of 20 m minima, from above."""

from _common import save, top_view, town

import pdal_stages as ps

points = town()
height = ps.hag_minima(points.x, points.y, points.z)
save("1_heights", top_view(points.x, points.y, points.z, values=height, width=900))
