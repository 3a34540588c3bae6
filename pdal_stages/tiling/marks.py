"""What runs inside PDAL beside the user's stages: numbering points, checking reaches, putting results in."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..pipeline.runtime import points_of
from .tileplan import MARGIN, ROW, SOURCE

#: Dimension -> rows (None: all) and their values.
Injected = Mapping[str, tuple[NDArray[np.int64] | None, NDArray]]
_MARK_TYPES = {ROW: "uint32_t", SOURCE: "uint32_t", MARGIN: "double"}
#: What stages in this module hand to the worker in the same process, by token.
_margins: dict[str, list[NDArray[np.float64]]] = {}
_before: dict[str, list[dict[str, NDArray]]] = {}
_needs: dict[str, float] = {}
_inject_data: dict[str, tuple[Injected, NDArray[np.bool_]]] = {}


def _stage(function: str, arguments: dict[str, Any], adds: dict[str, str]) -> dict[str, Any]:
    label = f"pdal_stages_tiling_{function}_{arguments['token']}_{arguments.get('number', 0)}"
    out: dict[str, Any] = {
        "type": "filters.python",
        "module": label,
        "function": "stage",
        "source": (
            f"from pdal_stages.tiling import marks\ndef stage(ins, outs):\n"
            f"    return marks.{function}(globals(), ins, outs)\n"
        ),
        "pdalargs": {**arguments, "label": label},
    }
    if adds:
        out["add_dimension"] = [f"{name}={kind}" for name, kind in adds.items()]
    return out


# ---- numbering -------------------------------------------------------------------------------------------


def mark_stage(token: str, number: int, margin: NDArray[np.float64], keep: bool) -> dict[str, Any]:
    """A stage after reader `number` that numbers its points.

    Parameters
    ----------
    token : str
        Of the tile's run.
    margin : ndarray
        Metres outside the tile, -1 inside, in the reader's order.
    keep : bool
        Keep all dimensions of the tile's own points, to see later which changed.
    """
    _margins.setdefault(token, []).append(margin)
    if len(_margins[token]) != number + 1:
        raise AssertionError("marks are made in order")
    return _stage("mark", {"token": token, "number": number, "keep": keep}, _MARK_TYPES)


def mark(module: dict[str, Any], ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> bool:
    """Number the points of one reader; see :func:`mark_stage`."""
    arguments = _arguments(module)
    token, number = arguments["token"], int(arguments["number"])
    margin = _margins[token][number]
    count = len(ins["X"])
    if count != len(margin):
        raise RuntimeError(f"the reader gave {count} points of {len(margin)}")
    outs[ROW] = np.arange(count, dtype=np.uint32)
    outs[SOURCE] = np.full(count, number, np.uint32)
    outs[MARGIN] = np.ascontiguousarray(margin, np.float64)
    if arguments["keep"]:
        mine = margin < 0
        kept = {name: values[mine] for name, values in ins.items() if name not in _MARK_TYPES}
        _before.setdefault(token, []).append({**kept, ROW: outs[ROW][mine], SOURCE: outs[SOURCE][mine]})
    return True


def originals(token: str) -> list[dict[str, NDArray]]:
    """What :func:`mark` kept."""
    return _before.get(token, [])


# ---- the terrain's reach ---------------------------------------------------------------------------------


def terrain_stage(
    token: str, number: int, options: dict[str, Any], within: float, core: list[float]
) -> dict[str, Any]:
    """A stage behind ``filters.hag_minima`` that finds how far its terrain reached.

    Parameters
    ----------
    token, number
        Of the tile's run, and of the stage.
    options : dict
        The terrain stage's options as given.
    within : float
        Metres outside the tile up to which heights are used by later stages (0: the tile's own points).
    core : list of float
        The tile, in the unit of the coordinates.
    """
    return _stage(
        "terrain", {"token": token, "number": number, "options": options, "within": within, "core": core}, {}
    )


def terrain(module: dict[str, Any], ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> bool:
    """Find how far the terrain under a tile reached; see :func:`terrain_stage`."""
    from ..stages.hag_minima import HagMinima

    arguments = _arguments(module)
    stage = HagMinima(arguments["options"])
    points = points_of(stage, module, ins)
    unit = points.units.horizontal
    margin = ins[MARGIN]
    wanted = margin <= arguments["within"] if arguments["within"] > 0 else margin < 0
    if points.mask is not None:
        wanted &= points.mask
    core = [c * unit for c in arguments["core"]]
    x, y = points.xyz[:, 0], points.xyz[:, 1]
    need = terrain_reach(x, y, stage.forms_terrain(points), wanted, stage.cell, stage.resolution, core)
    token = arguments["token"]
    _needs[token] = max(_needs.get(token, 0.0), need)
    return True


def terrain_reach(x, y, forms, wanted, cell: float, resolution: float, core) -> float:
    """Metres around a tile in which the terrain under its points is decided.

    A height takes the four coarse cells around a point; an empty one is filled from all cells within its
    nearest filled one's distance and 1.5 cells. All of these must have been read whole. What was
    found with too few points bounds the true reach from above.
    """
    from scipy.spatial import cKDTree

    if not wanted.any() or not forms.any():
        return 0.0
    filled = np.unique(np.column_stack([np.floor(x[forms] / cell), np.floor(y[forms] / cell)]), axis=0)
    fine = np.unique(
        np.column_stack([np.floor(x[wanted] / resolution), np.floor(y[wanted] / resolution)]), axis=0
    )
    low = np.floor((fine + 0.5) * (resolution / cell) - 0.5)
    cells = np.unique(np.concatenate([low + np.array([a, b]) for a in (0, 1) for b in (0, 1)]), axis=0)
    nearest = cKDTree(filled).query(cells)[0]
    radius = np.where(nearest > 0, nearest + 1.5, 0.0) + 0.5  # whole cells around it
    centre = cells + 0.5
    sides = [
        core[0] - (centre[:, 0] - radius) * cell,
        core[1] - (centre[:, 1] - radius) * cell,
        (centre[:, 0] + radius) * cell - core[2],
        (centre[:, 1] + radius) * cell - core[3],
    ]
    return float(max(0.0, max(s.max() for s in sides)))


def need(token: str) -> float:
    """Metres around the tile that the terrain stages needed."""
    return _needs.get(token, 0.0)


# ---- putting results in ----------------------------------------------------------------------------------


def inject_stage(
    token: str, number: int, values: Injected, keep: NDArray[np.bool_], adds: dict[str, str]
) -> dict[str, Any]:
    """A stage that gives points of reader `number` the values of dimensions.

    Parameters
    ----------
    values : mapping of str to (rows, ndarray)
        New values of a dimension and the reader's rows they belong to; None for all rows.
    keep : ndarray of bool
        Which of the reader's points stay.
    adds : dict
        PDAL types of the dimensions.
    """
    key = f"{token}_{number}"
    _inject_data[key] = (values, keep)
    return _stage("inject", {"token": token, "number": number}, adds)


def inject(module: dict[str, Any], ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> bool:
    """Give points their results; see :func:`inject_stage`."""
    arguments = _arguments(module)
    values, keep = _inject_data.pop(f"{arguments['token']}_{arguments['number']}")
    count = len(ins["X"])
    if count != len(keep):
        raise RuntimeError(f"the reader gave {count} points of {len(keep)}")
    for name, (rows, given) in values.items():
        if rows is None:
            outs[name] = np.ascontiguousarray(given, ins[name].dtype)
        else:
            full = np.array(ins[name])
            full[rows] = given
            outs[name] = full
    return True


def drop_stage(token: str, number: int, keep: NDArray[np.bool_]) -> dict[str, Any]:
    """A stage that drops points of reader `number`; PDAL wants it apart from new values."""
    _inject_data[f"{token}_{number}_drop"] = ({}, keep)
    return _stage("drop", {"token": token, "number": number}, {})


def drop(module: dict[str, Any], ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> bool:
    """Keep only some points; see :func:`drop_stage`."""
    arguments = _arguments(module)
    _, keep = _inject_data.pop(f"{arguments['token']}_{arguments['number']}_drop")
    outs["Mask"] = np.ascontiguousarray(keep, bool)
    return True


def forget(token: str) -> None:
    """Drop everything kept for a run."""
    for store in (_margins, _before, _needs):
        store.pop(token, None)  # type: ignore[attr-defined]
    for key in [k for k in _inject_data if k.startswith(f"{token}_")]:
        _inject_data.pop(key, None)


def _arguments(module: dict[str, Any]) -> dict[str, Any]:
    arguments = module["pdalargs"]
    with contextlib.suppress(KeyError):
        sys.modules.pop(arguments["label"])
    return arguments
