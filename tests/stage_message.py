"""What a stage itself said, found in PDAL's error text."""

from __future__ import annotations

from pdal_stages.pipeline.runtime import _CLOSING, _OPENING


def message_of(text: str) -> str | None:
    """A stage's own message in PDAL's error text, or None."""
    start, end = text.find(_OPENING), text.rfind(_CLOSING)
    return text[start + len(_OPENING) : end] if 0 <= start < end else None
