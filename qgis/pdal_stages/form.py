"""Parameters of a dialog, made of what the program says about an argument of a command or an option of a stage."""

import re

from qgis.core import (
    QgsProcessingParameterBoolean,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterEnum,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
)

#: One of several: blanks in it stand between quotes.
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
    """``reference_dimension`` -> ``Reference dimension``; of a checkbox what it does."""
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
        choices = [str(one) for one in declared["choices"]]
        index = (
            choices.index(str(default)) if default is not None and str(default) in choices else None
        )
        made = QgsProcessingParameterEnum(
            key, label, choices, defaultValue=index, optional=optional
        )
    elif kind == "boolean":
        made = QgsProcessingParameterBoolean(key, label, defaultValue=bool(default))
    elif kind in ("number", "integer"):
        made = QgsProcessingParameterNumber(
            key,
            label,
            type=QgsProcessingParameterNumber.Integer
            if kind == "integer"
            else QgsProcessingParameterNumber.Double,
            defaultValue=default,
            optional=optional,
        )
        if declared.get("minimum") is not None:
            made.setMinimum(declared["minimum"])
        if declared.get("maximum") is not None:
            made.setMaximum(declared["maximum"])
    else:
        text = "" if default is None else str(default)
        made = QgsProcessingParameterString(key, label, defaultValue=text, optional=optional)
    made.setHelp(declared["help"])
    if advanced:
        made.setFlags(made.flags() | QgsProcessingParameterDefinition.FlagAdvanced)
    return made


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
        [one.replace('"', "") for one in _WORDS.findall(value)] if declared["many"] else [value]
    )
    return [f"{declared['flag']}={one}" for one in several]
