"""Pipelines for what no command of the program does. No QGIS here."""

#: What is within one of several ranges stays, so two negated ones would leave all.
NOT_NOISE = {
    "type": "filters.range",
    "limits": "Classification[0:6],Classification[8:17],Classification[19:255]",
}


_PLAIN = """\
def plain(ins, outs):
    outs["Classification"] = ins["Classification"] & 31
    return True
"""


def reader(source):
    """Return a reader that reads extra dimensions of old LAS files as well."""
    if source.lower().endswith((".las", ".laz")) and not source.lower().endswith(".copc.laz"):
        return {"type": "readers.las", "filename": source, "use_eb_vlr": True}
    return {"filename": source}


def plain_classes(source):
    """Return the filter that takes flags of formats 0 to 5 off the classes (PDAL before 2.6)."""
    try:
        with open(source, "rb") as file:
            head = file.read(105)
    except OSError:
        return []  # the reader reports it
    if head[:4] != b"LASF" or len(head) < 105 or head[104] & 63 > 5:  # the point format
        return []
    return [{"type": "filters.python", "module": "classes", "function": "plain", "source": _PLAIN}]


def writer(target):
    """Return a writer that keeps everything."""
    if target.lower().endswith((".las", ".laz")) and not target.lower().endswith(".copc.laz"):
        return {"type": "writers.las", "filename": target, "forward": "all", "extra_dims": "all"}
    return {"filename": target}


def raster(target, side, dimension, what):
    """Return a writer of a GeoTIFF."""
    return {
        "type": "writers.gdal",
        "filename": target,
        "gdaldriver": "GTiff",
        "resolution": side,
        "dimension": dimension,
        "output_type": what,
        "radius": side * 0.5**0.5,
        "window_size": 2,
        "data_type": "float",
    }


def class_map(cloud, target, side):
    """Return a pipeline that draws the classes from above."""
    writes = {
        **raster(target, side, "Classification", "max"),
        "data_type": "uint8_t",
        "nodata": 0,
        "window_size": 1,
    }
    return [reader(cloud), *plain_classes(cloud), NOT_NOISE, writes]
