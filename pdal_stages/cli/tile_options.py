"""Flags of runs in tiles, which several commands share, and the records of them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

from ..base.errors import OptionError
from ..base.files import HTML, JSON, Output
from ..base.memory import parse_size
from ..tiling.options import PER, TilingOptions

#: Kinds of reports by the suffix of the file.
_REPORTS = {".html": HTML, ".htm": HTML, ".json": JSON}


@dataclass(frozen=True)
class RunFiles:
    """Files about a run, which are written beside its outputs."""

    metadata: str | None = None
    reports: tuple[str, ...] = ()  #: .html or .json

    def __post_init__(self) -> None:
        """Refuse reports of other kinds."""
        for name in self.reports:
            if Path(name).suffix.lower() not in _REPORTS:
                raise OptionError("--report writes .html or .json", found=name)

    @classmethod
    def parse(cls, options: argparse.Namespace) -> RunFiles:
        """Return the files that the flags name."""
        return cls(options.metadata, tuple(options.report))

    @property
    def outputs(self) -> list[Output]:
        """The files, to be checked before the run."""
        kinds = [(name, _REPORTS[Path(name).suffix.lower()]) for name in self.reports]
        metadata = [Output(self.metadata, "metadata", JSON)] if self.metadata else []
        return [*metadata, *(Output(name, "report", kind) for name, kind in kinds)]


def add_tile_options(command: argparse.ArgumentParser, survey: bool = False) -> None:
    """Add the flags to the parser of ``pipeline``, or of ``classify`` (a `survey`)."""
    when = "Several inputs and large files are cut into tiles" if survey else "Run in tiles"
    add = add_tile_sizes(command, f"{when} (docs/large-areas.md).")
    add(
        "--scheduler",
        default="",
        metavar="ADDRESS",
        help="A running Dask scheduler, tcp://HOST:8786",
    )
    per = "One output per input or per tile (auto: per input)"
    add("--per", choices=PER, default="auto", help=per)
    buffer = argparse.SUPPRESS if survey else "How far PDAL's own filters look beyond a tile"
    add("--buffer", type=float, metavar="METERS", help=buffer)
    add("--resume", action="store_true", help="Continue a run that was stopped or failed")
    add("--dry-run", action="store_true", help="Show tiles, memory and disk needed, then stop")
    report = "Write a report, .html or .json"
    add("--report", action="append", default=[], metavar="FILE", help=report)


def add_tile_sizes(
    command: argparse.ArgumentParser,
    what: str = "Points that do not fit in memory are read in tiles, which give the same model.",
) -> Callable:
    """Add the flags of ``train``, whose only output is a model; return what adds more."""
    add = command.add_argument_group("large areas", what).add_argument
    side = "Side of the tiles in the cloud's unit (default: auto)"
    add("--tile", type=_tile_side, metavar="SIZE", help=side)
    add("--memory", metavar="SIZE", help="Most memory to use, e.g. 4GB (default: half of free)")
    workers = "Worker processes, 0 for none (default: half the cores)"
    add("--workers", type=int, metavar="N", help=workers)
    return add


def _tile_side(text: str) -> float | str:
    """Return the value of ``--tile``."""
    try:
        return text if text == "auto" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"a length or auto, not {text!r}") from None


def tiling_options(options: argparse.Namespace) -> TilingOptions:
    """Return the options of tiles from the flags."""
    names = {field.name for field in fields(TilingOptions)}
    values = {name: value for name, value in vars(options).items() if name in names}
    values["tile"] = None if options.tile == "auto" else options.tile
    values["memory"] = None if options.memory is None else parse_size(options.memory)
    return TilingOptions(**values)


def requests_tiles(options: argparse.Namespace) -> bool:
    """Return whether ``pipeline`` runs in tiles; refuse other flags of tiles without it."""
    if options.tile is None:
        add_tile_options(usual := argparse.ArgumentParser())
        for name, default in vars(usual.parse_args([])).items():
            if getattr(options, name) != default:
                raise OptionError(
                    f"--{name.replace('_', '-')} needs --tile",
                    cure="Give the side of the tiles, e.g. --tile 500, or --tile auto",
                )
    return options.tile is not None
