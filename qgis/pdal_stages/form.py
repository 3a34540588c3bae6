"""Parameters of a dialog, from the declarations of commands' arguments and stages' options."""

import re

from qgis.core import (
    QgsProcessingParameterBoolean,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterEnum,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
)

#: One of several values; blanks within a value stand between quotes.
_WORDS = re.compile(r'(?:"[^"]*"|[^\s"])+')
#: Settings of a terminal, of a batch system, or that a dialog has its own widgets for.
LEFT_OUT = (
    "progress",
    "scheduler",
    "dry_run",
    "inputs",
    "output",
    "threads",
    "inputs_option",
)


def label_of(declared):
    """Return a label: ``Reference dimension`` for its name; for a checkbox what it does."""
    if declared["kind"] == "boolean":
        return re.split(r" \(|; |: ", declared["help"])[0]
    text = declared["name"].replace("_", " ")
    return text[:1].upper() + text[1:]


def parameter(declared, key, label="", advanced=False):
    """Return the QGIS parameter of a declared argument or option.

    Where it is left empty the program's own default holds, so numbers without a default are
    optional.
    """
    label = label or label_of(declared)
    if declared.get("unit"):
        label += f" [{declared['unit']}]"
    default, kind = declared["default"], declared["kind"]
    optional = not declared["required"]
    if declared["choices"]:
        choices = [str(choice) for choice in declared["choices"]]
        index = (
            choices.index(str(default)) if default is not None and str(default) in choices else None
        )
        widget = QgsProcessingParameterEnum(
            key, label, choices, defaultValue=index, optional=optional
        )
    elif kind == "boolean":
        widget = QgsProcessingParameterBoolean(key, label, defaultValue=bool(default))
    elif kind in ("number", "integer"):
        widget = QgsProcessingParameterNumber(
            key,
            label,
            type=QgsProcessingParameterNumber.Integer
            if kind == "integer"
            else QgsProcessingParameterNumber.Double,
            defaultValue=default,
            optional=optional,
        )
        if declared.get("minimum") is not None:
            widget.setMinimum(declared["minimum"])
        if declared.get("maximum") is not None:
            widget.setMaximum(declared["maximum"])
    else:
        text = "" if default is None else str(default)
        widget = QgsProcessingParameterString(key, label, defaultValue=text, optional=optional)
    widget.setHelp(declared["help"])
    if advanced:
        widget.setFlags(widget.flags() | QgsProcessingParameterDefinition.FlagAdvanced)
    return widget


def value_of(algorithm, declared, key, parameters, context):
    """Return a chosen value as text for the program; None for its default."""
    if parameters.get(key) is None:
        return None
    kind = declared["kind"]
    if declared["choices"]:
        value = str(declared["choices"][algorithm.parameterAsEnum(parameters, key, context)])
    elif kind == "boolean":
        value = algorithm.parameterAsBool(parameters, key, context)
        return None if value == bool(declared["default"]) else value
    elif kind == "integer":
        value = str(algorithm.parameterAsInt(parameters, key, context))
    elif kind == "number":
        number = algorithm.parameterAsDouble(parameters, key, context)
        if declared["default"] is not None and number == float(declared["default"]):
            return None
        value = repr(number)
    else:
        value = algorithm.parameterAsString(parameters, key, context).strip()
    return None if value == "" or value == str(declared["default"]) else value


def words(algorithm, declared, key, parameters, context):
    """Return the words of a command line for a chosen value."""
    value = value_of(algorithm, declared, key, parameters, context)
    if value is None:
        return []
    if declared["kind"] == "boolean":
        return [declared["flag"] if value else declared["off"] or declared["flag"]]
    several = (
        [word.replace('"', "") for word in _WORDS.findall(value)] if declared["many"] else [value]
    )
    return [f"{declared['flag']}={each}" for each in several]
