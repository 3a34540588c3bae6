"""The pipelines that are no command of the program. No QGIS here."""

NOT_NOISE = {"type": "filters.range", "limits": "Classification![7:7],Classification![18:18]"}


def reader(source):
    """A reader that sees extra dimensions of old LAS files too."""
    if source.lower().endswith((".las", ".laz")) and not source.lower().endswith(".copc.laz"):
        return {"type": "readers.las", "filename": source, "use_eb_vlr": True}
    return {"filename": source}


def writer(target):
    """A writer that keeps everything."""
    if target.lower().endswith((".las", ".laz")) and not target.lower().endswith(".copc.laz"):
        return {"type": "writers.las", "filename": target, "forward": "all", "extra_dims": "all"}
    return {"filename": target}


def raster(target, side, dimension, what):
    """A writer of a GeoTIFF."""
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
    """Classes from above."""
    writes = {
        **raster(target, side, "Classification", "max"),
        "data_type": "uint8_t",
        "nodata": 0,
        "window_size": 1,
    }
    return [reader(cloud), NOT_NOISE, writes]
