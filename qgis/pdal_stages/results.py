"""Show outputs on the map, with styles. In the main thread only."""

import os

from qgis.core import (
    QgsHillshadeRenderer,
    QgsPalettedRasterRenderer,
    QgsPointCloudCategory,
    QgsPointCloudClassifiedRenderer,
    QgsPointCloudLayer,
    QgsProcessingLayerPostProcessorInterface,
    QgsProviderRegistry,
    QgsRasterLayer,
    QgsSingleBandPseudoColorRenderer,
    QgsStyle,
    QgsVectorLayer,
)
from qgis.PyQt.QtGui import QColor

#: Layers of objects and of what is to be reviewed, the lowest on the map first.
LAYERS = ("tiles", "patches", "buildings", "decks", "crowns", "spans", "trees")
#: Rasters of the command ``surfaces``, the lowest on the map first.
SURFACES = ("terrain", "surface", "canopy")


def shows_point_clouds():
    """Return whether this QGIS reads LAS and LAZ files; Debian's does not."""
    return "pdal" in QgsProviderRegistry.instance().providerList()


def categories(classes):
    """Return categories of classes with the colors of all pictures of pdal-stages."""
    return [
        QgsPointCloudCategory(int(code), QColor(*described["color"]), described["name"])
        for code, described in classes.items()
    ]


def point_cloud(path, classes):
    """Return a layer of a LAS or LAZ file, colored by class."""
    layer = QgsPointCloudLayer(str(path), os.path.splitext(os.path.basename(path))[0], "pdal")
    if layer.isValid():
        layer.setRenderer(QgsPointCloudClassifiedRenderer("Classification", categories(classes)))
    return layer


def vector_layers(path):
    """Return the layers of a vector file with features; styles lie in it or beside it."""
    stem, ending = os.path.splitext(str(path))
    layers = []
    for name in LAYERS:
        source = (
            f"{path}|layername={name}" if ending.lower() == ".gpkg" else f"{stem}_{name}{ending}"
        )
        if ending.lower() != ".gpkg" and not os.path.exists(source):
            continue
        layer = QgsVectorLayer(source, name, "ogr")
        if layer.isValid() and layer.featureCount():
            if name == "crowns":
                layer.setOpacity(0.5)
            layers.append(layer)
    return layers


def raster_layer(path):
    """Return a layer of a raster of the command ``surfaces``: shaded relief, or colored heights."""
    name = os.path.splitext(os.path.basename(path))[0]
    layer = QgsRasterLayer(str(path), name, "gdal")
    if layer.isValid():
        (heights if name == "canopy" else hillshade)(layer)
    return layer


class Style(QgsProcessingLayerPostProcessorInterface):
    """Style a raster once it is on the map."""

    #: Processing holds no reference.
    _kept = []

    def __init__(self, apply_style):
        super().__init__()
        self._apply_style = apply_style
        Style._kept[:] = [*Style._kept[-20:], self]

    def postProcessLayer(self, layer, context, feedback):
        try:
            self._apply_style(layer)
            layer.triggerRepaint()
        except Exception as error:  # a style is no reason to lose a result
            feedback.pushWarning(f"The style could not be set: {error}")


def hillshade(layer):
    layer.setRenderer(QgsHillshadeRenderer(layer.dataProvider(), 1, 315.0, 45.0))


def heights(layer):
    """Style heights above ground, from 0 to the 99th percentile."""
    provider = layer.dataProvider()
    renderer = QgsSingleBandPseudoColorRenderer(provider, 1)
    most = provider.cumulativeCut(1, 0.0, 0.99)[1]
    renderer.setClassificationMin(0.0)
    renderer.setClassificationMax(max(most, 1.0))
    ramp = QgsStyle.defaultStyle().colorRamp("Viridis")
    if ramp is not None:
        renderer.createShader(ramp)
    layer.setRenderer(renderer)


def classes_of(classes):
    """Return a style for a raster of class codes, with the classes that occur."""

    def apply_style(layer):
        provider = layer.dataProvider()
        there = {
            int(entry.value) for entry in QgsPalettedRasterRenderer.classDataFromRaster(provider, 1)
        }
        shown = [
            QgsPalettedRasterRenderer.Class(
                int(code), QColor(*described["color"]), f"{code} {described['name']}"
            )
            for code, described in classes.items()
            if int(code) in there
        ]
        layer.setRenderer(QgsPalettedRasterRenderer(provider, 1, shown))

    return apply_style
