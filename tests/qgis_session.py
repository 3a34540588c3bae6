"""Run by QGIS's own Python, for what `qgis_process` cannot do: styles, parameters; prints JSON.

python3 qgis_session.py FOLDER_OF_THE_PLUGIN styles|parameters ARGUMENT...
"""

import json
import sys

from qgis.core import QgsApplication, QgsProcessingContext, QgsProcessingFeedback, QgsProject

sys.path.append("/usr/share/qgis/python/plugins")


class Feedback(QgsProcessingFeedback):
    def __init__(self):
        super().__init__(False)
        self.lines = []

    def pushInfo(self, text):
        self.lines.append(text)

    pushCommandInfo = pushWarning = pushInfo

    def reportError(self, error, fatalError=False):
        self.lines.append(error)

    def setProgressText(self, text):
        self.lines.append(f"progress: {text}")


def start(folder):
    app = QgsApplication([], False)
    app.initQgis()
    from processing.core.Processing import Processing

    Processing.initialize()
    sys.path.insert(0, folder)
    import pdal_stages

    plugin = pdal_stages.classFactory(None)
    plugin.initProcessing()
    return app, plugin


def styles(objects, terrain, heights, classes):
    """Return the renderers of results on the map, and the color of buildings."""
    from qgis.core import QgsRasterLayer

    from pdal_stages import results

    forms = QgsApplication.processingRegistry().providerById("pdalstages").forms()
    layers = {}
    for name, path, act in (
        ("terrain", terrain, results.hillshade),
        ("heights", heights, results.heights),
        ("classes", classes, results.classes_of(forms["classes"])),
    ):
        layer = QgsRasterLayer(path, name)
        results.Style(act).postProcessLayer(layer, QgsProcessingContext(), Feedback())
        layers[name] = layer.renderer().type()
    for layer in results.vector_layers(objects):
        layers[layer.name()] = layer.renderer().type()
        QgsProject.instance().addMapLayer(layer)
    colors = {
        each.value(): each.color().getRgb()[:3] for each in results.categories(forms["classes"])
    }
    return {"layers": layers, "building": colors[6]}


def parameters(name):
    """The parameters of an algorithm: name, description, whether advanced, default."""
    algorithm = QgsApplication.processingRegistry().algorithmById(f"pdalstages:{name}")
    ok, why = algorithm.canExecute()
    return {
        "can": [ok, why],
        "parameters": {
            each.name(): [
                each.description(),
                bool(each.flags() & each.FlagAdvanced),
                str(each.defaultValue()),
                each.help(),
            ]
            for each in algorithm.parameterDefinitions()
        },
    }


if __name__ == "__main__":
    folder, what, *rest = sys.argv[1:]
    app, plugin = start(folder)
    print(json.dumps({"styles": styles, "parameters": parameters}[what](*rest)), flush=True)
    plugin.unload()
    app.exitQgis()
