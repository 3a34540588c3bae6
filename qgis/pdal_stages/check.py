"""The algorithm that says what is missing; it is there when nothing else is."""

from qgis.core import QgsProcessingException, QgsProcessingOutputString

from . import environment, running
from .base import Named


class CheckInstallation(Named):
    key, title = "check", "Check the installation"

    def createInstance(self):
        return CheckInstallation()

    def shortHelpString(self):
        return (
            "<p>Looks for the program pdal-stages and lets it tell what is there on this machine "
            "(PDAL, its Python, cores, memory, compiled kernels, extras), with the cure for what "
            "is not.</p><p>Which program is used: Settings &gt; Options &gt; Processing &gt; "
            "Providers &gt; pdal-stages.</p>"
        )

    def initAlgorithm(self, configuration=None):
        self.addOutput(QgsProcessingOutputString("PROGRAM", "Program"))
        self.addOutput(QgsProcessingOutputString("VERSION", "Version"))

    def processAlgorithm(self, parameters, context, feedback):
        try:
            program = self.provider().program()
            feedback.pushInfo(f"Program: {program}")
            version = environment.ask(program, "--version").split()[-1]
            feedback.pushInfo(f"Version: {version}")
            running.run(program, ["doctor"], feedback)
        except (environment.Missing, running.Failed) as error:
            raise QgsProcessingException(str(error)) from None
        return {"PROGRAM": program, "VERSION": version}
