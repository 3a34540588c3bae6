"""Detect wires and their towers and poles by shape, each in a module with its thresholds."""
