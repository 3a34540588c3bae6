"""Detect bridge decks, wires, towers and poles by shape, each in a module with its thresholds."""
