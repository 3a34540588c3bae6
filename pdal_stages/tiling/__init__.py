"""Pipelines over any number and size of inputs: tiles with a halo, on one host or several, without
seams.
"""
