"""Pipelines over inputs of any number and size: tiles with a halo, on one host or many, written seamlessly."""
