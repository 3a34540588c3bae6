"""Names for what JSON holds, so that signatures say which object is meant."""

from __future__ import annotations

from typing import Any

#: A stage of a pipeline as PDAL writes it: ``type``, ``tag``, ``inputs`` and its options by name.
StageJson = dict[str, Any]
#: What an object of JSON holds by name: a record of a run, a description of a model, metadata.
JsonObject = dict[str, Any]
