"""The algorithms: which commands and pipelines they run, and what of it comes onto the map."""

import html
import json
import os

from qgis.core import (
    QgsProcessingException,
    QgsProcessingOutputHtml,
    QgsProcessingOutputString,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterNumber,
    QgsProcessingParameterPoint,
    QgsProcessingParameterRasterDestination,
    QgsProject,
)

from . import results
from .base import CLOUDS, Algorithm, written
from .jobs import NOT_NOISE, class_map, plain_classes, raster, reader, writer

_VECTORS = "GeoPackage (*.gpkg);;GeoJSON (*.geojson);;FlatGeobuf (*.fgb);;Shapefiles (*.shp)"
_AREAS = "Polygons (*.gpkg *.geojson *.fgb *.shp);;All files (*)"
_CORRECTED = (
    "Point clouds, tables, layers (*.laz *.las *.csv *.gpkg *.geojson *.fgb *.shp);;All files (*)"
)
_MODELS = "Model files (*.model);;All files (*)"
_TABLES = "Tables (*.csv *.txt);;All files (*)"
_PAGES = "Pages (*.html)"
_REPORTS = "Reports (*.json)"
_SHOW = "Show the result on the map"
_NO_CLOUDS = (
    "This QGIS is built without support for LAS and LAZ files, so the point cloud is not shown: {}"
)


class _Showing(Algorithm):
    """Adds layers to the project when all is done, in the main thread."""

    def add_show(self):
        self.addParameter(QgsProcessingParameterBoolean("SHOW", _SHOW, defaultValue=True))

    def prepareAlgorithm(self, parameters, context, feedback):
        self.to_show = []
        return True

    def show_clouds(self, paths, parameters, context):
        if self.parameterAsBool(parameters, "SHOW", context):
            self.to_show += [("cloud", path) for path in paths]

    def postProcessAlgorithm(self, context, feedback):
        project = context.project() or QgsProject.instance()
        for kind, path in self.to_show:
            if kind == "vector":
                layers = results.vector_layers(path)
            elif kind == "raster":
                layers = [results.raster_layer(path)]
            elif results.shows_point_clouds():
                layers = [results.point_cloud(path, self.forms["classes"])]
            else:
                feedback.pushInfo(_NO_CLOUDS.format(path))
                continue
            for layer in layers:
                if layer.isValid():
                    project.addMapLayer(layer)
                else:
                    feedback.pushWarning(f"{path} cannot be shown")
        return {}

    def add_raster(self, key, label, help, optional=True, default=True):
        parameter = QgsProcessingParameterRasterDestination(
            key, label, optional=optional, createByDefault=default
        )
        parameter.setHelp(help)
        self.addParameter(parameter)

    def add_cell(self, label):
        kind = QgsProcessingParameterNumber.Double
        parameter = QgsProcessingParameterNumber("RESOLUTION", label, kind, 1.0, minValue=0.01)
        parameter.setHelp("Side of a raster's cells in the unit of the coordinates")
        self.addParameter(parameter)

    def style(self, context, path, act):
        """Return a style for a raster that QGIS will show."""
        if context.willLoadLayerOnCompletion(path):
            context.layerToLoadOnCompletionDetails(path).setPostProcessor(results.Style(act))


class _Classifying(_Showing):
    command = "classify"
    listed = ("dimensions", "noise", "towers", "bridges", "vegetation_heights", "polygons", "where")

    def add_model(self):
        name = self.forms["models"][0] if self.forms["models"] else ""
        self.add_file(
            "MODEL",
            f"Model (empty: {name}, which comes with pdal-stages)",
            "A model file that was trained on labels of your own; empty takes the shipped one",
            _MODELS,
            optional=True,
        )

    def model(self, parameters, context):
        path = self.parameterAsFile(parameters, "MODEL", context)
        return [f"--model={path}"] if path else []


class ClassifyFile(_Classifying):
    """One file."""

    key, title = "classify", "Classify a point cloud"
    about = (
        "Gives each point of a raw airborne laser scan a class: ground, vegetation, building and "
        "more, with the model that comes with pdal-stages or one of your own. Coordinates and "
        "return numbers are read; all other dimensions, the header and the reference system stay "
        "as they are."
    )
    handled = ("model", "report", "per", "resume", "metadata")

    def initAlgorithm(self, configuration=None):
        self.add_file("INPUT", "Point cloud", "A LAS, LAZ or COPC file, or any that PDAL reads")
        self.add_model()
        self.add_declared()
        self.add_destination("OUTPUT", "Classified point cloud", "The same points with classes")
        self.add_raster(
            "MAP",
            "Map of classes",
            "A picture of the result from above: the highest class code of each cell",
        )
        self.add_cell("Cell of the map")
        self.add_show()

    def processAlgorithm(self, parameters, context, feedback):
        source = self.parameterAsFile(parameters, "INPUT", context)
        target = self.destination(parameters, "OUTPUT", context)
        chosen = self.arguments(parameters, context)
        self.execute(
            ["classify", *chosen, *self.model(parameters, context), source, target], feedback
        )
        self.show_clouds([target], parameters, context)
        out = {"OUTPUT": target}
        if parameters.get("MAP"):
            out["MAP"] = written(self.parameterAsOutputLayer(parameters, "MAP", context))
            side = self.parameterAsDouble(parameters, "RESOLUTION", context)
            self.execute(
                ["pipeline", "--stdin"], feedback, json.dumps(class_map(target, out["MAP"], side))
            )
            self.style(context, out["MAP"], results.classes_of(self.forms["classes"]))
        return out


class ClassifySurvey(_Classifying):
    """Files and folders, in tiles."""

    key, title = "classifysurvey", "Classify many point clouds"
    about = (
        "Classifies files and folders in tiles without seams, within a bound for memory: as many "
        "files come out as go in. What an earlier run in the same folder finished can be kept, so "
        "a canceled run goes on where it stopped."
    )
    listed = ("memory", "resume", *_Classifying.listed)
    handled = ("model", "report", "metadata")

    def initAlgorithm(self, configuration=None):
        self.add_inputs(self.help_of("inputs"))
        self.add_model()
        self.add_declared()
        parameter = QgsProcessingParameterFolderDestination(
            "OUTPUT", "Folder of classified point clouds"
        )
        self.addParameter(parameter)
        self.add_destination(
            "REPORT",
            "Report",
            self.help_of("report"),
            _REPORTS,
            optional=True,
            createByDefault=False,
        )
        self.addParameter(QgsProcessingParameterBoolean("SHOW", _SHOW, defaultValue=False))

    def processAlgorithm(self, parameters, context, feedback):
        target = written(self.parameterAsString(parameters, "OUTPUT", context), folder=True)
        more = [*self.arguments(parameters, context), *self.model(parameters, context)]
        report = self.destination(parameters, "REPORT", context)
        if report:
            more.append(f"--report={report}")
        before = set(os.listdir(target))
        # A folder is named by its end, where it is not there yet
        self.execute(
            ["classify", *more, *self.inputs(parameters, context), os.path.join(target, "")],
            feedback,
        )
        names = (
            sorted(os.listdir(target))
            if "RESUME" in parameters
            else sorted(set(os.listdir(target)) - before)
        )
        clouds = [
            os.path.join(target, name) for name in names if name.lower().endswith((".laz", ".las"))
        ]
        self.show_clouds(clouds, parameters, context)
        return {"OUTPUT": target, **({"REPORT": report} if report else {})}


class Heights(_Showing):
    """Compute the dimension HeightAboveGround."""

    key, title, stage = "heights", "Heights above ground", "filters.hag_morphological"
    about = (
        "Finds the ground of a point cloud, classified or not, and writes the height of each point "
        "above it as the dimension HeightAboveGround. Classes stay as they are."
    )
    command = "pipeline"
    listed = ("cell", "slope", "window", "threshold", "ground")

    def initAlgorithm(self, configuration=None):
        self.add_file("INPUT", "Point cloud")
        self.add_declared()
        self.add_destination("OUTPUT", "Point cloud with heights")
        self.add_raster("MAP", "Map of heights above ground", "The highest of each cell")
        self.add_cell("Cell of the map")
        self.add_show()

    def processAlgorithm(self, parameters, context, feedback):
        target = self.destination(parameters, "OUTPUT", context)
        stage = {"type": self.stage, **self.options(parameters, context)}
        source = self.parameterAsFile(parameters, "INPUT", context)
        job = [reader(source), stage, writer(target)]
        out = {"OUTPUT": target}
        if parameters.get("MAP"):
            out["MAP"] = written(self.parameterAsOutputLayer(parameters, "MAP", context))
            side = self.parameterAsDouble(parameters, "RESOLUTION", context)
            job += [
                *plain_classes(source),
                NOT_NOISE,
                raster(out["MAP"], side, "HeightAboveGround", "max"),
            ]
        self.execute(["pipeline", "--stdin"], feedback, json.dumps(job))
        self.show_clouds([target], parameters, context)
        if "MAP" in out:
            self.style(context, out["MAP"], results.heights)
        return out


class TerrainModels(_Showing):
    """Rasters of the ground and of what stands on it."""

    key, title = "terrainmodels", "Terrain and surface model"
    about = (
        "Makes rasters of a point cloud: the terrain as a surface through the ground points (a "
        "triangulation, so buildings are bridged), the surface as the highest point of each cell, "
        "and how far that is above the terrain."
    )
    command, stage = "pipeline", "filters.hag_morphological"
    GROUND = ("Found by the filter", "Classes 2, 9 and 11 of the point cloud")
    listed = ("slope", "window", "threshold")
    handled = ("ground", "openings", "terrain_slope", "where")

    def initAlgorithm(self, configuration=None):
        self.add_file("INPUT", "Point cloud")
        parameter = QgsProcessingParameterEnum(
            "GROUND_FROM", "Ground", list(self.GROUND), defaultValue=0
        )
        parameter.setHelp(
            "Which points the terrain goes through: those that the filter below finds, or those "
            "classified as ground, water or road"
        )
        self.addParameter(parameter)
        self.add_cell("Cell of the rasters")
        self.add_declared()
        self.add_raster("TERRAIN", "Terrain model", "Through the ground points")
        self.add_raster(
            "SURFACE", "Surface model", "The highest point of each cell; noise (7, 18) is left out"
        )
        self.add_raster(
            "HEIGHTS",
            "Heights above the terrain",
            "The highest of each cell, above the terrain that the filter finds",
            default=False,
        )

    def processAlgorithm(self, parameters, context, feedback):
        chosen = {
            key: written(self.parameterAsOutputLayer(parameters, key, context))
            for key in ("TERRAIN", "SURFACE", "HEIGHTS")
            if parameters.get(key)
        }
        if not chosen:
            raise QgsProcessingException("No raster was asked for.")
        side = self.parameterAsDouble(parameters, "RESOLUTION", context)
        by_class = self.parameterAsEnum(parameters, "GROUND_FROM", context) == 1
        stage = {"type": self.stage, **self.options(parameters, context), "ground": True}
        source = self.parameterAsFile(parameters, "INPUT", context)
        # One line: of several ends PDAL runs only the first
        job = [
            reader(source),
            {"type": "filters.detachednoise"},
            stage,
            *plain_classes(source),
            NOT_NOISE,
        ]
        if "SURFACE" in chosen:
            job.append(raster(chosen["SURFACE"], side, "Z", "max"))
        if "HEIGHTS" in chosen:
            job.append(raster(chosen["HEIGHTS"], side, "HeightAboveGround", "max"))
        if "TERRAIN" in chosen:
            given = "Classification[2:2],Classification[9:9],Classification[11:11]"
            limits = given if by_class else "Ground[1:1]"
            job += [
                {"type": "filters.range", "limits": limits},
                {"type": "filters.delaunay"},
                {"type": "filters.faceraster", "resolution": side},
                {"type": "writers.raster", "filename": chosen["TERRAIN"], "gdaldriver": "GTiff"},
            ]
        self.execute(["pipeline", "--stdin"], feedback, json.dumps(job))
        for key, path in chosen.items():
            self.style(context, path, results.heights if key == "HEIGHTS" else results.hillshade)
        return chosen


class Surfaces(_Showing):
    """Rasters of a classified survey."""

    key, title, command = (
        "surfaces",
        "Terrain, surface and canopy of classified point clouds",
        "surfaces",
    )
    about = (
        "Makes rasters of classified point clouds of any number: the terrain through the ground "
        "points, the surface as the highest point of each cell, and the canopy as what is above "
        "the terrain, on one grid without seams. The points must be classified."
    )
    listed = ("resolution", "fill", "max_radius", "resume")
    handled = ("folder",)

    def initAlgorithm(self, configuration=None):
        self.add_inputs(self.help_of("inputs"))
        self.add_declared()
        self.addParameter(
            QgsProcessingParameterFolderDestination("OUTPUT", "Folder of the rasters")
        )
        self.add_show()

    def processAlgorithm(self, parameters, context, feedback):
        target = written(self.parameterAsString(parameters, "OUTPUT", context), folder=True)
        chosen = [*self.arguments(parameters, context), *self.inputs(parameters, context)]
        self.execute(["surfaces", *chosen, target], feedback)
        names = [os.path.join(target, f"{name}.tif") for name in results.SURFACES]
        if self.parameterAsBool(parameters, "SHOW", context):
            self.to_show += [("raster", path) for path in names]
        return {"OUTPUT": target}


class Train(Algorithm):
    """Train a model file from labels."""

    key, title, command = "train", "Train a model", "train"
    about = (
        "Trains a model on labeled point clouds, from nothing or on top of a model that knows much "
        "already: then few labels are enough. It is scored on points that it has not seen; the "
        "score is in the log."
    )
    listed = ("base", "classes", "count")
    handled = ("model",)

    def initAlgorithm(self, configuration=None):
        self.add_inputs(self.help_of("inputs"))
        self.add_declared()
        self.add_destination("MODEL", "Model", self.help_of("model"), _MODELS)

    def processAlgorithm(self, parameters, context, feedback):
        target = self.destination(parameters, "MODEL", context)
        chosen = [*self.arguments(parameters, context), f"--model={target}"]
        self.execute(["train", *chosen, *self.inputs(parameters, context)], feedback)
        return {"MODEL": target}


class Accuracy(Algorithm):
    """Compare classes with a reference and show the report."""

    key, title, command = "accuracy", "Accuracy of a classified point cloud", "accuracy"
    about = (
        "Compares the classes of a point cloud with true ones: of another file with the same "
        "points, or of another dimension. The report (tables, confusion matrix, maps of errors) is "
        "under Processing > Results Viewer."
    )
    listed = ("dimension", "reference_dimension")
    handled = ("reference", "json", "html")

    def initAlgorithm(self, configuration=None):
        self.add_file("INPUT", "Classified point cloud")
        self.add_file(
            "REFERENCE",
            "The same points with true classes",
            self.help_of("reference"),
            CLOUDS,
            optional=True,
        )
        self.add_declared()
        self.add_destination("PAGE", "Report", files=_PAGES)
        self.add_destination(
            "JSON",
            "Figures",
            self.help_of("json"),
            "JSON (*.json)",
            optional=True,
            createByDefault=False,
        )
        self.addOutput(QgsProcessingOutputHtml("HTML", "Report"))
        self.addOutput(QgsProcessingOutputString("FIGURES", "Table"))

    def processAlgorithm(self, parameters, context, feedback):
        page = self.destination(parameters, "PAGE", context)
        chosen = [*self.arguments(parameters, context), f"--html={page}"]
        reference = self.parameterAsFile(parameters, "REFERENCE", context)
        if reference:
            chosen.append(f"--reference={reference}")
        figures = self.destination(parameters, "JSON", context)
        if figures:
            chosen.append(f"--json={figures}")
        text = self.execute(
            ["accuracy", *chosen, self.parameterAsFile(parameters, "INPUT", context)], feedback
        )
        return {
            "PAGE": page,
            "HTML": page,
            "FIGURES": text,
            **({"JSON": figures} if figures else {}),
        }


class Report(Algorithm):
    """Write the page by which a survey is accepted."""

    key, title, command = "report", "Report of a survey", "report"
    about = (
        "Measures classified point clouds: density, voids, heights of strips against each other, "
        "and control points from a table. The page is under Processing > Results Viewer."
    )
    listed = ("density", "void")
    handled = ("control", "json", "page")

    def initAlgorithm(self, configuration=None):
        self.add_inputs(self.help_of("inputs"))
        self.add_file("CONTROL", "Control points", self.help_of("control"), _TABLES, optional=True)
        self.add_declared()
        self.add_destination("PAGE", "Report", files=_PAGES)
        self.addOutput(QgsProcessingOutputHtml("HTML", "Report"))

    def processAlgorithm(self, parameters, context, feedback):
        page = self.destination(parameters, "PAGE", context)
        control = self.parameterAsFile(parameters, "CONTROL", context)
        chosen = [
            *self.arguments(parameters, context),
            *([f"--control={control}"] if control else []),
        ]
        self.execute(["report", *chosen, *self.inputs(parameters, context), page], feedback)
        return {"PAGE": page, "HTML": page}


class Objects(_Showing):
    """Vectors."""

    key, title, command = "objects", "Buildings, trees, wires and bridges as vectors", "objects"
    about = (
        "Groups the points of classified point clouds into objects and writes them as layers: "
        "buildings with straight outlines and heights, trees and crowns, wires, bridge decks, "
        "each with a verdict: sure, or to be checked and why. Objects across the borders of "
        "files are whole."
    )
    listed = ("outlines", "cell")
    handled = ("metadata",)

    def initAlgorithm(self, configuration=None):
        self.add_inputs(self.help_of("inputs"))
        self.add_declared()
        self.add_destination("OUTPUT", "Objects", self.help_of("output"), _VECTORS)
        self.add_show()

    def processAlgorithm(self, parameters, context, feedback):
        target = self.destination(parameters, "OUTPUT", context)
        self.execute(
            [
                "objects",
                *self.arguments(parameters, context),
                *self.inputs(parameters, context),
                target,
            ],
            feedback,
        )
        if self.parameterAsBool(parameters, "SHOW", context):
            self.to_show.append(("vector", target))
        return {"OUTPUT": target}


class Review(_Showing):
    """List the places that a person should check."""

    key, title, command = (
        "review",
        "Where to look: likely errors of a classified point cloud",
        "review",
    )
    about = (
        "Lists where a person should look in classified point clouds, worst first, as patches with "
        "the number of errors expected in each. What is right or was corrected can be learned "
        "from: see Corrections."
    )
    listed = ("share",)
    handled = ("json",)

    def initAlgorithm(self, configuration=None):
        self.add_inputs(self.help_of("inputs"))
        self.add_declared()
        self.add_destination("OUTPUT", "Patches", self.help_of("output"), _VECTORS)
        self.add_show()

    def processAlgorithm(self, parameters, context, feedback):
        target = self.destination(parameters, "OUTPUT", context)
        chosen = self.arguments(parameters, context)
        self.execute(["review", *chosen, *self.inputs(parameters, context), target], feedback)
        if self.parameterAsBool(parameters, "SHOW", context):
            self.to_show.append(("vector", target))
        return {"OUTPUT": target}


class Explain(_Classifying):
    """Tell why a point has its class."""

    key, title, command = "explain", "Why: the reasons for the class of a point", "explain"
    about = (
        "Tells of the point nearest to a place on the map what the ground filter made of it, which "
        "inputs of the model spoke for its class and against it, what came after, and what differs "
        "from the run that classified the file. Give the options of that run. The text is in the "
        "log and under Processing > Results Viewer."
    )
    listed = ("noise", "towers", "bridges", "vegetation_heights", "keep_sure")
    handled = ("cloud", "place", "points", "crs", "json", "model")

    def initAlgorithm(self, configuration=None):
        self.add_file("INPUT", "Point cloud", self.help_of("cloud"))
        point = QgsProcessingParameterPoint("POINT", "Place")
        point.setHelp(self.help_of("place"))
        self.addParameter(point)
        self.add_model()
        self.add_declared()
        self.add_destination("PAGE", "Reasons", files=_PAGES)
        self.addOutput(QgsProcessingOutputHtml("HTML", "Reasons"))
        self.addOutput(QgsProcessingOutputString("REASONS", "Reasons"))

    def processAlgorithm(self, parameters, context, feedback):
        page = self.destination(parameters, "PAGE", context)
        point = self.parameterAsPoint(parameters, "POINT", context)
        crs = self.parameterAsPointCrs(parameters, "POINT", context)
        chosen = [*self.model(parameters, context), *self.arguments(parameters, context)]
        chosen += [f"--crs={crs.authid() or crs.toWkt()}"] if crs.isValid() else []
        place = [self.parameterAsFile(parameters, "INPUT", context), *map(repr, point)]
        text = self.execute(["explain", *chosen, *place], feedback)
        with open(page, "w", encoding="utf-8") as file:
            file.write(f'<meta charset="utf-8"><pre>{html.escape(text)}</pre>')
        return {"PAGE": page, "HTML": page, "REASONS": text}


class Corrections(_Showing):
    """Mark points that a person has checked, for training."""

    key, title, command = "corrections", "Corrections: mark what was looked at", "corrections"
    about = (
        "Marks the points whose classes a person has corrected, or looked at and found right, in "
        "the dimension Checked: training then learns from these points alone."
    )
    listed = ("around",)
    handled = ("before", "after", "out", "area")

    def initAlgorithm(self, configuration=None):
        self.add_file("BEFORE", "Point cloud as it was classified", self.help_of("before"))
        self.add_file("AFTER", "Corrected", self.help_of("after"), _CORRECTED, optional=True)
        self.add_file("AREA", "What was looked at", self.help_of("area"), _AREAS, optional=True)
        self.add_declared()
        self.add_destination("OUTPUT", "Checked point cloud", self.help_of("out"))
        self.add_show()

    def processAlgorithm(self, parameters, context, feedback):
        target = self.destination(parameters, "OUTPUT", context)
        before, after, area = (
            self.parameterAsFile(parameters, key, context) for key in ("BEFORE", "AFTER", "AREA")
        )
        chosen = [*self.arguments(parameters, context), f"--out={target}"]
        chosen += [f"--area={area}"] if area else []
        self.execute(["corrections", *chosen, before, *([after] if after else [])], feedback)
        self.show_clouds([target], parameters, context)
        return {"OUTPUT": target}


ALGORITHMS = (
    ClassifyFile,
    ClassifySurvey,
    Heights,
    TerrainModels,
    Surfaces,
    Report,
    Train,
    Accuracy,
    Review,
    Explain,
    Corrections,
    Objects,
)
