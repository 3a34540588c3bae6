"""Detect bridge decks by shape, with its thresholds."""
