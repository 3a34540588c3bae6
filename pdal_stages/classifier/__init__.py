"""Classifiers: training on labeled clouds, the model file, classifying clouds. NumPy in and out; no PDAL."""
