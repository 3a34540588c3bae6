"""Model files whose manifests were changed as a whole, loaded and put to work while every file that is opened is watched.

What a model file asks for may be anything; what comes of it must be an error of ours, or a pipeline that reads the cloud, runs
the stages that a model may carry and writes the output. No file is opened but the model and the cloud, none written but the
output, no program started, no code compiled.
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

import hostile
import numpy as np
import targets

from pdal_stages.base.errors import StageError
from pdal_stages.classifier import TrainingCloud, TrainingOptions, modelfile, train
from pdal_stages.pipeline.classify_request import ClassifyRequest
from pdal_stages.pipeline.run import Pipeline
from pdal_stages.stages import carried, registry
from pdal_stages.stages.loading import load_model

#: Every so many models that are accepted, one is run by PDAL.
_RUN_EVERY = 25
#: What Python reports that a model file must not cause. (NumPy compiles the literals in the heads of arrays, and does not run them.)
_FORBIDDEN = ("subprocess.", "os.system", "os.exec", "os.posix_spawn", "os.fork", "socket.", "ctypes.dlopen", "exec",
              "import", "marshal.", "pickle.find_class", "code.__new__", "shutil.", "os.rename", "os.remove", "os.rmdir", "os.mkdir",
              "os.link", "os.symlink", "os.truncate", "os.chmod", "os.chown", "os.putenv", "urllib.", "http.", "webbrowser.")  # fmt: skip


class Watch:
    """What happens while it is on."""

    on = False
    seen: list[str] = []
    allowed: set[str] = set()

    @classmethod
    def hook(cls, event: str, arguments: tuple) -> None:
        if not cls.on:
            return
        if event == "open":
            path = (
                os.fsdecode(arguments[0])
                if isinstance(arguments[0], str | bytes | os.PathLike)
                else "(a descriptor)"
            )
            flags = arguments[2] if isinstance(arguments[2], int) else 0
            writes = bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND))
            if writes or path not in cls.allowed:
                cls.seen.append(f"open {path} {arguments[1]}")
        elif event.startswith(_FORBIDDEN):
            cls.seen.append(f"{event} {str(arguments)[:200]}")


@cache
def watched() -> type[Watch]:
    """The watch, put up once: a hook cannot be taken down."""
    sys.addaudithook(Watch.hook)
    return Watch


@cache
def folder() -> Path:
    made = hostile.folder() / "manifests"
    made.mkdir()
    return made


@cache
def good() -> dict[str, bytes]:
    """Members of a small model file that needs heights, and says where from."""
    rng = np.random.default_rng(0)
    xyz = np.round(rng.uniform(0, 12, (400, 3)), 2)
    labels = np.where(xyz[:, 2] > 6, 6, 2)
    options = TrainingOptions(
        neighborhoods="c1", feature_set=["covariance"], dimensions=("HeightAboveGround",), count=60, trees=2, threads=1,
        passes=1, folds=0,
    )  # fmt: skip
    model = train(
        [TrainingCloud(xyz, labels, {"HeightAboveGround": xyz[:, 2]}, "fuzz")], options, progress=False
    )
    model.info["preparation"] = [{"type": "filters.hag_minima", "cell": 5}]
    path = folder() / "good.model"
    model.save(path)
    import zipfile

    with zipfile.ZipFile(path) as archive:
        return {info.filename: archive.read(info) for info in archive.infolist()}


@cache
def cloud() -> Path:
    import laspy

    rng = np.random.default_rng(1)
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = [0.01] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = rng.uniform(0, 12, (3, 200))
    las.write(folder() / "in.las")
    return folder() / "in.las"


# ---- changes ---------------------------------------------------------------------------------------------------

_STAGES = ["filters.python", "filters.stats", "filters.head", "filters.range", "filters.transformation", "filters.hag_dem",
           "filters.merge", "filters.shell", "filters.programmable", "filters.colorization", "filters.overlay", "readers.las",
           "writers.las", "filters.modelclassifier", "writers.classifiermodel"]  # fmt: skip
_OPTIONS = ["source", "script", "log", "dir", "option_file", "raster", "json", "html", "bins", "model", "filename", "count",
            "limits", "matrix", "where", "tag", "inputs", "user_data", "threads", "datasource", "command", "pdalargs", "type",
            "horizontal_unit", "where_merge", "__class__", "classbits"]  # fmt: skip


def _words() -> list[Any]:
    trap = str(folder() / "trap")
    return [
        trap, f"file://{trap}", f"../../../../..{trap}", f"'; open({trap!r}, 'w')", "/etc/passwd", "/dev/stdout", "~/.bashrc",
        "$(touch /tmp/x)", "standard", "", "\0", "\x1b[2J", "\n", "NaN", "1e999", 0, -1, 1, 2, 5, 1e-300, 1e300, 10**400, 2**63,
        True, False, None, [], {}, [[]], [trap], {"type": "filters.python", "source": trap}, "Z > 1", "Classification[7:7]",
        "last,only", "HeightAboveGround", "Classification", "c1", "c2,s3", "kopt", "X" * 3000,
    ]  # fmt: skip


def _stage(rng: random.Random) -> dict[str, Any]:
    ours = {
        name: dict(kind.in_models) for name, kind in registry.stages().items() if kind.in_models is not None
    }
    known = {**ours, **carried.OF_PDAL}
    kind = rng.choice([*known, *known, *_STAGES, *registry.stages()])
    names = [*known.get(kind, {}), *rng.sample(_OPTIONS, 3)]
    honest = {
        "cell": 2,
        "window": 10,
        "ground": True,
        "openings": [5],
        "count": 3,
        "ignore": "Classification[7:7]",
    }
    options = {}
    for name in rng.sample(names, rng.randint(0, min(3, len(names)))):
        options[name] = honest[name] if name in honest and rng.random() < 0.6 else rng.choice(_words())
    return {**options, "type": kind}


def _places(node: Any, way: tuple = ()) -> list[tuple]:
    out = [way] if way else []
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        out += _places(value, (*way, key))
    return out


def changed(rng: random.Random) -> dict[str, Any]:
    """A manifest with some values, keys and parts replaced, moved, doubled or left out."""
    head = json.loads(good()[modelfile.MANIFEST])
    if rng.random() < 0.7:
        head["preparation"] = [_stage(rng) for _ in range(rng.choice([1, 1, 1, 2, 3, 9]))]
    if rng.random() < 0.1:
        head["by_hand"] = rng.choice([["filters.smrf"], ["filters.python"], [_words()[0]], 5])
    for _ in range(rng.choice([0, 0, 1, 2, 5])):
        places = _places(head)
        way = rng.choice(places)
        node = head
        for key in way[:-1]:
            node = node[key]
        kind = rng.randrange(5)
        if kind == 0:
            node[way[-1]] = rng.choice(_words())
        elif kind == 1 and isinstance(node, dict):
            del node[way[-1]]
        elif kind == 2 and isinstance(node, dict):
            node[rng.choice([*_OPTIONS, *node])] = rng.choice(_words())
        elif kind == 3:
            other = head
            for key in rng.choice(places):
                other = other[key] if isinstance(other, dict | list) else other
            node[way[-1]] = copy.deepcopy(other)
        elif isinstance(node, list):
            node.insert(rng.randint(0, len(node)), rng.choice(_words()))
    return head


# ---- the target ------------------------------------------------------------------------------------------------

_accepted = 0


def manifest(data: bytes) -> str:
    """Load a changed model and make the pipeline of `classify` with it; "refused" or "loaded"."""
    global _accepted
    rng = random.Random(data)
    path, source, target = folder() / "fuzz.model", cloud(), folder() / "out.las"
    members = dict(good())
    text = json.dumps(changed(rng)).encode()
    if rng.random() < 0.1:
        at = rng.randrange(len(text))
        text = (
            text[:at]
            + rng.choice([b"", b'"', b"{", b"\\u0000", b"1e999", b"//"])
            + text[at + rng.randrange(3) :]
        )
    members[modelfile.MANIFEST] = targets._rehashed(text, members)
    path.write_bytes(targets.packed(members))
    watch = _warm(path)
    before = sorted(os.listdir(folder()))
    watch.allowed = {str(path), str(source)}
    watch.seen.clear()
    watch.on = True
    pipeline = None
    try:
        made = load_model(path)
        pipeline = _put_to_work(made, path, source, target)
        outcome = "loaded"
    except StageError as error:
        assert str(error).strip().endswith((".", "?", "!")) and "Traceback" not in str(error)
        outcome = "refused"
    finally:
        watch.on = False
    assert not watch.seen, watch.seen[:5]
    if pipeline is not None:
        _accepted += 1
        crashes = {s["type"] for s in pipeline.source.stages} & set(
            carried.NEEDS_GROUND
        )  # PDAL 2.2, without ground
        if _accepted % _RUN_EVERY == 0 and not crashes:
            before = sorted({*before, target.name})
            try:
                pipeline.execute(arrays=False)
            except StageError:
                target.touch()  # dimensions that the cloud lacks, and the like
    assert sorted(os.listdir(folder())) == before, "a file appeared"
    assert not (folder() / "trap").exists()
    return outcome


def _put_to_work(made: Any, path: Path, source: Path, target: Path) -> Pipeline | None:
    """What the command does with a model before PDAL runs: describe it, and build the pipeline."""
    text = str(made)
    assert text and "\x1b" not in json.dumps(made.describe(), default=str)
    asked = made.info.get("preparation") or []
    for stage in asked:
        rules = carried.OF_PDAL.get(stage["type"])
        assert set(stage) - {"type"} <= set(registry.get(stage["type"]).in_models if rules is None else rules)
    pipeline = ClassifyRequest(str(path)).pipeline(str(source), str(target))
    own = [
        s
        for s in pipeline.source.stages
        if s not in asked and s["type"] not in ("readers.las", "writers.las")
    ]
    assert {s["type"] for s in own} <= set(registry.stages()) | set(carried.OF_PDAL), own
    for stage in asked:
        assert "/" not in json.dumps({k: v for k, v in stage.items() if k != "where"})
    bare = Pipeline([str(source), {"type": "filters.modelclassifier", "model": str(path)}])
    assert bare.lowered.ours
    return pipeline


@cache
def _warmed() -> bool:
    """Load and run once, so that what is imported or compiled on the way is there."""
    path = folder() / "warm.model"
    path.write_bytes(targets.packed(good()))
    try:
        load_model(folder() / "good.model")
        _put_to_work(load_model(path), path, cloud(), folder() / "out.las").execute(arrays=False)  # type: ignore[union-attr]
    except StageError:
        pass
    try:
        load_model(cloud())
    except StageError:
        pass
    return True


def _warm(path: Path) -> type[Watch]:
    _warmed()
    return watched()


TARGETS = {"manifest": manifest}


def seeds(name: str) -> list[bytes]:
    """Each stands for a series of random changes."""
    return [bytes([number]) * 8 for number in range(20)]
