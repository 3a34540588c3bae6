"""First steps: a town of our own, and kernels compiled beforehand."""

from __future__ import annotations

import argparse
import re

from ..base.errors import OptionError
from .adder import Adder


def add_commands(add: Adder) -> None:
    """``demo`` and ``warmup``."""
    takes = add("demo", _demo, "Generate a town, train on one half, classify the other")
    takes("folder", nargs="?", default="pdal-stages-demo", help="Where results go")
    takes("--size", type=float, default=200.0, help="Side of the town in meters")
    takes("--density", type=float, default=7.0, help="Points per square meter")
    takes("--seed", type=int, default=1)

    takes = add(
        "warmup", _warmup, "Compile the kernels for this machine once, so that later runs start without delay"
    )
    takes("--all", action="store_true", help="Those of kopt, ropt, copt and shape distributions too")


def _demo(options: argparse.Namespace) -> None:
    from ..synthetic.demo import run_demo

    try:
        run_demo(options.folder, size=options.size, density=options.density, seed=options.seed)
    except OptionError as error:
        error.what = re.sub(r"^'(\w+)'", r"'--\1'", error.what)
        raise


def _warmup(options: argparse.Namespace) -> None:
    """What the demo, the default heights, training and classification use, on a few points of no meaning."""
    import numpy as np

    from ..classifier import TrainingCloud, TrainingOptions, train
    from ..synthetic.demo import compile_kernels
    from ..terrain import detached_noise, filtered_ground, hag_minima

    compile_kernels()
    # A deck over a valley, with land at both of its ends: what is asked of decks is asked only where one may be.
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-120.0, 120.0), np.arange(-80.0, 80.0)))
    z = np.where(abs(y) <= 4.0, 6.0, np.clip((abs(x) - 15.0) / 7.5, 0.0, 6.0))
    filtered_ground(x, y, z, openings=(5,), decks=True, threads=1)
    xyz = np.random.default_rng(0).uniform(0.0, 12.0, (400, 3))
    axes = np.ascontiguousarray(xyz.T)
    detached_noise(*axes)
    dimensions = filtered_ground(*axes, openings=(5,), threads=1)
    dimensions["HeightAboveGround"] = hag_minima(*axes)
    dimensions |= dict.fromkeys(("ReturnNumber", "NumberOfReturns"), np.ones(len(xyz), np.uint8))
    how = TrainingOptions(
        neighborhoods="s5,k10",
        feature_set="covariance,geometric,surfaces",
        dimensions=("HeightAboveGround", "Ground", "HeightAboveOpening_5", "returns"),
        context=("own", *TrainingOptions().context),  # shipped models read the point's own as well
        trees=1,
        count=50,
        threads=1,
    )
    model = train(TrainingCloud(xyz, np.where(xyz[:, 2] > 6.0, 6, 2), dimensions), how, progress=False)
    model.predict(xyz, dimensions, threads=1)
    if options.all:
        from ..features import warmup as every_neighborhood

        every_neighborhood()
