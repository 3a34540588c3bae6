"""Detect bridge decks, wires and towers by shape, each in a module with its thresholds."""
