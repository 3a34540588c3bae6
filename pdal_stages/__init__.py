"""PDAL pipeline stages that turn raw airborne laser scans into classified ones."""

__version__ = "0.1.0"
