"""What all algorithms share: the program, its run, its arguments as parameters."""

import difflib
import os

from qgis.core import (
    QgsProcessing,
    QgsProcessingAlgorithm,
    QgsProcessingException,
    QgsProcessingParameterFile,
    QgsProcessingParameterFileDestination,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterRasterDestination,
)

from . import environment, form, running

CLOUDS = "Point clouds (*.laz *.las *.copc.laz *.LAZ *.LAS *.ply *.e57 *.bpf);;All files (*)"
LAZ = "LAZ files (*.laz);;LAS files (*.las);;COPC files (*.copc.laz)"


class Named(QgsProcessingAlgorithm):
    """Base of algorithms: the name and the provider's icon, which QGIS requests."""

    key = title = ""

    def name(self):
        return self.key

    def displayName(self):
        return self.title

    def group(self):
        return ""

    def groupId(self):
        return ""

    def icon(self):
        return self.provider().icon() if self.provider() else super().icon()


class Algorithm(Named):
    """An algorithm that runs commands of the program.

    `command` names the command (or `stage` the stage) whose declarations give the parameters that
    `listed` and `advanced` name; what a new version adds is found under "Advanced" by itself.
    """

    about = command = ""
    stage = ""
    listed = ()
    #: Names of arguments for which the algorithm adds parameters itself.
    handled = ()

    def __init__(self, forms):
        super().__init__()
        self.forms = forms
        self.declared = {}

    @classmethod
    def available(cls, forms):
        """Return whether the program has the commands and stages that are needed."""
        return (not cls.command or cls.command in forms["commands"]) and (
            not cls.stage or cls.stage in forms["stages"]
        )

    def createInstance(self):
        return type(self)(self.forms)

    def shortHelpString(self):
        lines = [f"<p>{self.about}</p>"]
        for parameter in self.parameterDefinitions():
            if parameter.help():
                lines.append(
                    f"<p><b>{parameter.description()}</b>: {_escaped(parameter.help())}</p>"
                )
        return "".join(lines)

    def canExecute(self):
        try:
            self.provider().program()
        except environment.Missing as error:
            return False, str(error)
        return True, ""

    # ---- parameters

    def checkParameterValues(self, parameters, context):
        """Refuse what QGIS accepts: unknown names, other formats of rasters, texts as numbers."""
        known = {each.name(): each for each in self.parameterDefinitions()}
        for key, value in parameters.items():
            parameter = known.get(key)
            if parameter is None:
                near = difflib.get_close_matches(key.upper(), known, 1)
                cure = f"Did you mean {near[0]}?" if near else f"There are {', '.join(known)}."
                return False, f"There is no parameter {key}. {cure}"
            if isinstance(parameter, QgsProcessingParameterRasterDestination) and value:
                ok, why = self.provider().isSupportedOutputValue(value, parameter, context)
                if not ok:
                    return False, f"{key}: {why}. Give a name that ends in .tif."
            if (
                isinstance(parameter, QgsProcessingParameterNumber)
                and isinstance(value, str)
                and value.strip()
            ):
                whole = parameter.dataType() == QgsProcessingParameterNumber.Integer
                try:
                    int(value) if whole else float(value)
                except ValueError:
                    return False, f"{key} must be a {'whole ' * whole}number (found '{value}')."
        return super().checkParameterValues(parameters, context)

    def add_declared(self):
        """Add the arguments of a command or stage: those of `listed`, then others as advanced."""
        if self.stage:
            declared = self.forms["stages"][self.stage]["options"]
        else:
            declared = self.forms["commands"][self.command]["arguments"]
        by_name = {each["name"]: each for each in declared}
        rest = [
            name for name in by_name if name not in (*self.listed, *self.handled, *form.LEFT_OUT)
        ]
        for name in (*(name for name in self.listed if name in by_name), *rest):
            self.add_argument(by_name[name], name.upper(), advanced=name not in self.listed)

    def add_argument(self, declared, key, advanced=False, label=""):
        self.declared[key] = declared
        self.addParameter(form.parameter(declared, key, label, advanced))

    def arguments(self, parameters, context):
        """Return the values of the dialog as words of a command line."""
        out = []
        for key, declared in self.declared.items():
            out += form.words(self, declared, key, parameters, context)
        return out

    def options(self, parameters, context):
        """Return the values of the dialog as options of a stage."""
        chosen = {
            declared["name"]: form.value_of(self, declared, key, parameters, context)
            for key, declared in self.declared.items()
        }
        return {name: value for name, value in chosen.items() if value is not None}

    def help_of(self, name):
        """Return the command's help text for one of its arguments."""
        arguments = self.forms["commands"][self.command]["arguments"]
        return next((each["help"] for each in arguments if each["name"] == name), "")

    def add_file(self, key, label, help="", files=CLOUDS, optional=False):
        parameter = QgsProcessingParameterFile(key, label, fileFilter=files, optional=optional)
        parameter.setHelp(help)
        self.addParameter(parameter)

    def add_destination(self, key, label, help="", files=LAZ, **how):
        parameter = QgsProcessingParameterFileDestination(key, label, files, **how)
        parameter.setHelp(help)
        self.addParameter(parameter)

    def destination(self, parameters, key, context):
        """Return the chosen file, in a folder that exists; empty where none was chosen."""
        path = self.parameterAsFileOutput(parameters, key, context)
        return written(path) if path else ""

    def add_inputs(self, help=""):
        """Add parameters for files and a folder."""
        parameter = QgsProcessingParameterMultipleLayers(
            "INPUTS", "Point clouds", QgsProcessing.TypeFile, optional=True
        )
        parameter.setHelp(help)
        self.addParameter(parameter)
        folder = QgsProcessingParameterFile(
            "FOLDER",
            "Folder of point clouds",
            behavior=QgsProcessingParameterFile.Folder,
            optional=True,
        )
        folder.setHelp("All point clouds in it, in addition to the files above")
        self.addParameter(folder)

    def inputs(self, parameters, context):
        """Return the names of the chosen files and folder."""
        files = [name for name in self.parameterAsFileList(parameters, "INPUTS", context) if name]
        folder = self.parameterAsFile(parameters, "FOLDER", context)
        names = [*files, *([folder] if folder else [])]
        if not names:
            raise QgsProcessingException("No point cloud was given: add files, or name a folder.")
        return names

    # ---- running

    def execute(self, arguments, feedback, text=None, quiet=False):
        """Run the program; raise QGIS's exception with its message where it fails."""
        try:
            return running.run(self.provider().program(), arguments, feedback, text, quiet)
        except (running.Failed, environment.Missing) as error:
            raise QgsProcessingException(str(error)) from None


def written(path, folder=False):
    """Return a destination whose folder exists."""
    os.makedirs(path if folder else os.path.dirname(os.path.abspath(path)), exist_ok=True)
    return path


def _escaped(text):
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
