"""Review (an extra): where errors are expected, and which points a person corrected."""
