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
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    from ..base.threads import available_threads
    from ..classifier.warmup import features_part, other_part, warmup
    from ..synthetic.demo import compile_kernels

    workers = min(2, available_threads())
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for done in [pool.submit(part) for part in (features_part, other_part, compile_kernels)]:
            done.result()
    warmup()  # shows that all are there and work together
    if options.all:
        from ..features import warmup as every_neighborhood

        every_neighborhood()
