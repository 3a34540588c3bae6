"""The provider: its settings, and algorithms made of what the program says it can do."""

import os

from processing.core.ProcessingConfig import ProcessingConfig, Setting
from qgis.core import Qgis, QgsApplication, QgsMessageLog, QgsProcessingProvider
from qgis.PyQt.QtGui import QIcon

from . import environment

SETTING = "PDAL_STAGES_PROGRAM"


class Provider(QgsProcessingProvider):
    """Algorithms that run the program ``pdal-stages``."""

    def id(self):
        return "pdalstages"

    def name(self):
        return "pdal-stages"

    def longName(self):
        return "pdal-stages: classified airborne laser scans"

    def icon(self):
        return QIcon(os.path.join(os.path.dirname(__file__), "icon.svg"))

    def supportedOutputRasterLayerExtensions(self):
        return ["tif", "tiff"]

    def supportsNonFileBasedOutput(self):
        return False

    def load(self):
        ProcessingConfig.settingIcons[self.name()] = self.icon()
        text = "Program pdal-stages, or the folder of its environment (empty: it is looked for)"
        ProcessingConfig.addSetting(Setting(self.name(), SETTING, text, "", valuetype=Setting.FILE))
        ProcessingConfig.readSettings()
        self.refreshAlgorithms()
        return True

    def unload(self):
        ProcessingConfig.removeSetting(SETTING)

    def program(self):
        """Return the program's path, or raise :class:`environment.Missing`."""
        return environment.find(ProcessingConfig.getSetting(SETTING) or "")

    def forms(self):
        """Return the arguments of commands and stages; None where they are not known."""
        try:
            cache = os.path.join(QgsApplication.qgisSettingsDirPath(), "cache", "pdal_stages")
            return environment.forms(self.program(), cache)
        except (environment.Missing, OSError) as error:
            QgsMessageLog.logMessage(str(error), "pdal-stages", Qgis.Warning)
            return environment.shipped()

    def loadAlgorithms(self):
        from .algorithms import ALGORITHMS
        from .check import CheckInstallation

        self.addAlgorithm(CheckInstallation())
        forms = self.forms()
        if forms is None:
            return
        for kind in ALGORITHMS:
            if kind.available(forms):
                self.addAlgorithm(kind(forms))
