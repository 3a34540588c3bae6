"""What kind of file something is, told from its first bytes."""

from __future__ import annotations

import os

LAS, MODEL, CHECKPOINT = "a LAS or LAZ file", "a model file", "a training's checkpoint"
JSON, HTML, PNG = "a JSON file", "an HTML page", "a PNG picture"
#: The first bytes of files that people would miss.
_BEGINNINGS = {
    b"LASF": LAS,
    b"\x89PNG": PNG,
    b"ply\n": "a PLY file",
    b"ply\r": "a PLY file",
    b"BPF!": "a BPF file",
    b"II*\0": "a TIFF file",
    b"MM\0*": "a TIFF file",
    b"SQLite format 3\0": "an SQLite or GeoPackage file",
    b"%PDF": "a PDF file",
    b"\x7fELF": "a program",
    b"#!": "a program",
    b"\x1f\x8b": "a gzip archive",
}


def kind_of(path: str | os.PathLike) -> str:
    """The kind of a file, as messages say it; empty where there is no file, nothing in it, or it is not known."""
    try:
        with open(path, "rb") as file:
            head = file.read(512)
    except OSError:
        return ""
    for beginning, kind in _BEGINNINGS.items():
        if head.startswith(beginning):
            return kind
    if head.startswith(b"PK\x03\x04"):
        first = head[30 : 30 + int.from_bytes(head[26:28], "little")]
        return {b"manifest.json": MODEL, b"archive/data.pkl": CHECKPOINT}.get(first, "a zip archive")
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if text.startswith((b"<!doctype html", b"<html")):
        return HTML
    return JSON if text.startswith((b"{", b"[")) else ""
