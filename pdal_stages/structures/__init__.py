"""Detect bridge decks and wires by shape, each in a module with its thresholds."""
