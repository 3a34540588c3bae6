"""The pictures of docs/qgis.md, of QGIS itself with the plugin of this checkout.

    PDAL_STAGES_DATA=FOLDER xvfb-run -s "-screen 0 1500x950x24" \
        qgis --nologo --noversioncheck --profiles-path /tmp/profile --code docs/qgis_pictures.py

Run it in the checkout, with PDAL_STAGES_PROGRAM=.venv/bin/pdal-stages, in a shell where no virtual
environment is active: QGIS would take its Python. QGIS closes by itself.
"""

import os
import sys
import tempfile
import traceback
from collections import Counter

from qgis.core import QgsProject, QgsRasterLayer
from qgis.PyQt.QtCore import QEventLoop, QTimer
from qgis.PyQt.QtGui import QImage
from qgis.PyQt.QtWidgets import QTreeView
from qgis.utils import iface

ROOT = os.getcwd()  # QGIS does not say where the script is
PICTURES = os.path.join(ROOT, "docs", "pictures")
TILE = os.path.join(os.environ["PDAL_STAGES_DATA"], "montpellier", "train_77055_627755.laz")
DIALOGS = {
    "qgis-classify.png": (
        "classify",
        {"INPUT": "/data/survey/raw.laz", "OUTPUT": "/data/survey/classified.laz"},
    ),
    "qgis-terrain.png": (
        "terrainmodels",
        {"INPUT": "/data/survey/classified.laz", "GROUND_FROM": 1},
    ),
}


def load():
    sys.path.insert(0, os.path.join(ROOT, "qgis"))
    import pdal_stages

    plugin = pdal_stages.classFactory(iface)
    plugin.initGui()
    return plugin


def settle(seconds=1.0):
    """Let QGIS draw."""
    loop = QEventLoop()
    QTimer.singleShot(int(seconds * 1000), loop.quit)
    loop.exec_()


def keep(widget, name):
    """A picture of its 256 commonest colors, which is small."""
    image = widget.grab().toImage().convertToFormat(QImage.Format_RGB32)
    pixels = memoryview(image.constBits().asstring(image.sizeInBytes())).cast("I")
    colors = [color for color, _ in Counter(pixels).most_common(256)]
    image.convertToFormat(QImage.Format_Indexed8, colors).save(
        os.path.join(PICTURES, name), quality=0
    )


def dialogs():
    import processing

    for name, (algorithm, chosen) in DIALOGS.items():
        dialog = processing.createAlgorithmDialog(f"pdalstages:{algorithm}", chosen)
        dialog.resize(1000, 780 if algorithm == "classify" else 720)
        dialog.show()
        settle()
        keep(dialog, name)
        dialog.close()


def the_map(plugin, folder):
    import processing

    from pdal_stages import results

    cloud, objects, classes, surface = (
        os.path.join(folder, name)
        for name in ("classified.laz", "objects.gpkg", "classes.tif", "surface.tif")
    )
    processing.run(
        "pdalstages:classify", {"INPUT": TILE, "OUTPUT": cloud, "MAP": classes, "SHOW": False}
    )
    parameters = {"INPUT": cloud, "RESOLUTION": 0.5, "TERRAIN": None, "SURFACE": surface}
    processing.run("pdalstages:terrainmodels", parameters)
    processing.run("pdalstages:objects", {"INPUTS": [cloud], "OUTPUT": objects, "SHOW": False})
    layers = [QgsRasterLayer(classes, "Map of classes"), QgsRasterLayer(surface, "Surface model")]
    results.classes_of(plugin.provider.forms()["classes"])(layers[0])
    results.hillshade(layers[1])
    for layer in [*layers, *results.vector_layers(objects)]:
        QgsProject.instance().addMapLayer(layer)
    QgsProject.instance().setCrs(layers[0].crs())
    window = iface.mainWindow()
    window.findChild(object, "Browser").setVisible(False)
    toolbox = window.findChild(object, "ProcessingToolbox")
    toolbox.setVisible(True)
    tree = toolbox.findChild(QTreeView)
    for row in range(tree.model().rowCount()):
        index = tree.model().index(row, 0)
        tree.setExpanded(index, "pdal-stages" in str(index.data()))
    window.resize(1500, 950)
    iface.mapCanvas().setExtent(layers[0].extent())
    iface.mapCanvas().refresh()
    settle(8)
    keep(window, "qgis-map.png")


def pictures():
    try:
        plugin = load()
        dialogs()
        with tempfile.TemporaryDirectory() as folder:
            the_map(plugin, folder)
    except Exception:
        traceback.print_exc()
    finally:
        os._exit(0)  # a window would ask whether to save


QTimer.singleShot(4000, pictures)
