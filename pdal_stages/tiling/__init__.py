"""Run pipelines over inputs of any number and size: tiles with a halo, without seams."""
