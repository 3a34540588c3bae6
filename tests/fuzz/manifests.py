"""Model files whose manifests were changed as a whole, loaded and put to work while every file that is opened is watched.

What a model file asks for may be anything; what comes of it must be an error of ours, or a pipeline that reads the cloud, runs
the stages that a model may carry and writes the output. No file is opened but the model and the cloud, no program started, no
code compiled.
"""

from __future__ import annotations

import copy
import json
import os
import random
import sys
from functools import cache
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from targets import folder, good_model, packed, put, target

from pdal_stages.base.errors import StageError
from pdal_stages.classifier import modelfile
from pdal_stages.pipeline.classify_request import ClassifyRequest
from pdal_stages.pipeline.run import Pipeline
from pdal_stages.stages import preparation, registry
from pdal_stages.stages.loading import load_model

#: What Python reports that a model file must not cause. (NumPy compiles the literals in the heads of arrays, and does not run them.)
_FORBIDDEN = ("subprocess.", "os.system", "os.exec", "os.posix_spawn", "os.fork", "socket.", "ctypes.dlopen", "exec",
              "import", "marshal.", "pickle.find_class", "code.__new__", "shutil.", "os.rename", "os.remove", "os.rmdir", "os.mkdir",
              "os.link", "os.symlink", "os.truncate", "os.chmod", "os.chown", "os.putenv", "urllib.", "http.", "webbrowser.")  # fmt: skip
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
#: Files that may be read while the watch is on, and what else happened.
_allowed: set[str] | None = None
_seen: list[str] = []


def _watch(event: str, arguments: tuple) -> None:
    if _allowed is None:
        return
    if event == "open":
        path = os.fsdecode(arguments[0]) if isinstance(arguments[0], str | bytes | os.PathLike) else ""
        if path not in _allowed or (isinstance(arguments[2], int) and arguments[2] & _WRITES):
            _seen.append(f"open {path} {arguments[1]}")
    elif event.startswith(_FORBIDDEN):
        _seen.append(f"{event} {str(arguments)[:200]}")


@cache
def cloud() -> Path:
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = [0.01] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.random.default_rng(1).uniform(0, 12, (3, 200))
    las.write(folder() / "in.las")
    return folder() / "in.las"


# ---- changes ---------------------------------------------------------------------------------------------------

_STAGES = ["filters.python", "filters.stats", "filters.head", "filters.range", "filters.transformation", "filters.hag_dem",
           "filters.shell", "filters.programmable", "filters.overlay", "readers.las", "writers.las", "filters.modelclassifier"]  # fmt: skip
_OPTIONS = ["source", "script", "log", "dir", "option_file", "raster", "json", "html", "bins", "model", "filename", "count",
            "limits", "matrix", "where", "tag", "inputs", "threads", "command", "pdalargs", "type", "horizontal_unit",
            "where_merge", "__class__", "classbits"]  # fmt: skip
_HONEST = {
    "cell": 2,
    "window": 10,
    "ground": True,
    "openings": [5],
    "count": 3,
    "ignore": "Classification[7:7]",
}


def _words() -> list[Any]:
    trap = str(folder() / "trap")
    return [
        trap, f"file://{trap}", f"../../../../..{trap}", f"'; open({trap!r}, 'w')", "/etc/passwd", "/dev/stdout", "~/.bashrc",
        "standard", "", "\0", "\x1b[2J", "\n", "NaN", "1e999", 0, -1, 1, 2, 5, 1e-300, 1e300, 10**400, 2**63,
        True, False, None, [], {}, [[]], [trap], {"type": "filters.python", "source": trap}, "Z > 1", "Classification[7:7]",
        "last,only", "HeightAboveGround", "Classification", "c1", "c2,s3", "kopt", "X" * 3000,
    ]  # fmt: skip


def carried() -> dict[str, tuple[str, ...]]:
    """Stages that a model may carry, and which options of theirs."""
    ours = {name: kind.in_models for name, kind in registry.stages().items() if kind.in_models}
    return ours | {
        name: tuple(one.name for one in options) for name, options in preparation.PDAL_OPTIONS.items()
    }


def _stage(rng: random.Random) -> dict[str, Any]:
    known = carried()
    kind = rng.choice([*known, *known, *_STAGES, *registry.stages()])
    names = [*known.get(kind, ()), *rng.sample(_OPTIONS, 3)]
    options = {}
    for name in rng.sample(names, rng.randint(0, min(3, len(names)))):
        options[name] = _HONEST[name] if name in _HONEST and rng.random() < 0.6 else rng.choice(_words())
    return {**options, "type": kind}


def _places(node: Any, way: tuple = ()) -> list[tuple]:
    out = [way] if way else []
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        out += _places(value, (*way, key))
    return out


def _at(node: Any, way: tuple) -> Any:
    for key in way:
        node = node[key]
    return node


def changed(rng: random.Random) -> bytes:
    """A manifest with some values, keys and parts replaced, moved, doubled or left out."""
    head = json.loads(good_model()[modelfile.MANIFEST])
    if rng.random() < 0.7:
        head["preparation"] = [_stage(rng) for _ in range(rng.choice([1, 1, 1, 2, 3, 9]))]
    if rng.random() < 0.1:
        head["by_hand"] = rng.choice([["filters.smrf"], ["filters.python"], [_words()[0]], 5])
    for _ in range(rng.choice([0, 0, 1, 2, 5])):
        places = _places(head)
        *way, last = rng.choice(places)
        node, kind = _at(head, tuple(way)), rng.randrange(5)
        if kind == 0:
            node[last] = rng.choice(_words())
        elif kind == 1 and isinstance(node, dict):
            del node[last]
        elif kind == 2 and isinstance(node, dict):
            node[rng.choice([*_OPTIONS, *node])] = rng.choice(_words())
        elif kind == 3:
            node[last] = copy.deepcopy(_at(head, rng.choice(places)))
        elif isinstance(node, list):
            node.insert(rng.randint(0, len(node)), rng.choice(_words()))
    return json.dumps(head).encode()


# ---- the target ------------------------------------------------------------------------------------------------


@target(lambda: [bytes([number]) * 8 for number in range(20)])
def manifest(data: bytes) -> str:
    """Load a changed model and make the pipeline of `classify` with it; the bytes stand for a series of random changes."""
    global _allowed
    _warm()
    rng = random.Random(data)
    path = put("fuzz.model", packed(good_model(), changed(rng)))
    before = sorted(os.listdir(folder()))
    _allowed = {str(path), str(cloud())}
    _seen.clear()
    try:
        pipeline = _put_to_work(path)
    finally:
        _allowed = None
        assert not _seen, _seen[:5]
        assert sorted(os.listdir(folder())) == before, "a file appeared"
    without_ground = {s["type"] for s in pipeline.source.stages} & set(
        preparation.NEEDS_GROUND
    )  # where PDAL 2.2 ends
    if rng.random() < 0.04 and not without_ground:
        pipeline.execute(arrays=False)
        (folder() / "out.las").unlink()
    assert not (folder() / "trap").exists()
    return "loaded"


def _put_to_work(path: Path) -> Pipeline:
    """What the command does with a model before PDAL runs: describe it, and build the pipeline."""
    made = load_model(path)
    assert str(made) and "\x1b" not in json.dumps(made.describe(), default=str)
    asked = made.info.get("preparation") or []
    for stage in asked:
        assert set(stage) - {"type"} <= set(carried()[stage["type"]])
        assert "/" not in json.dumps({k: v for k, v in stage.items() if k != "where"})
    pipeline = ClassifyRequest(str(path)).pipeline(str(cloud()), str(folder() / "out.las"))
    own = {s["type"] for s in pipeline.source.stages if s not in asked} - {"readers.las", "writers.las"}
    assert own <= set(registry.stages()) | set(preparation.PDAL_OPTIONS), own
    assert Pipeline([str(cloud()), {"type": "filters.modelclassifier", "model": str(path)}]).lowered.ours
    return pipeline


@cache
def _warm() -> None:
    """Load, run and refuse once, so that what is imported or compiled on the way is there; a hook cannot be taken down."""
    _put_to_work(put("warm.model", packed(good_model()))).execute(arrays=False)
    (folder() / "out.las").unlink()
    try:
        load_model(cloud())
    except StageError:
        pass
    sys.addaudithook(_watch)
