"""Pipelines of readers.las and stages of ours alone, run without PDAL: from a file's records straight to the stages.

PDAL takes a copy of every dimension of every point for each filter that is Python, and keeps its own beside them. In tiles,
whose points are cut out of files record by record in any case, that is a tenth of the time and half of the memory. So PDAL
reads a few of the points, and what it makes of them is how all are read: its dimensions and their types, the spatial
reference, the metadata. A dimension is decoded here only where that gives what PDAL gave, bit for bit, and for whatever
else it takes PDAL, it is PDAL that runs (:class:`NeedsPdal`).
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.extrabytes import number_type, plain_dimensions
from ..base.las import read_header
from . import callbacks, runtime
from . import pdal as pdal_env

#: Options of a reader that change nothing but the spatial reference, and which dimensions there are beside the plain ones.
_PLAIN = {
    *("type", "filename", "tag", "default_srs", "override_srs", "spatialreference", "nosrs"),
    *("use_eb_vlr", "extra_dims"),
}
_LIMITS = re.compile(r"(\w+)\[:([-+.\de]+)\]")


class RecordFields(Protocol):
    """Points as a file has them: arrays of their fields, by laspy's names."""

    def __len__(self) -> int: ...

    def __getitem__(self, field: str, /) -> NDArray: ...


class NeedsPdal(StageError):
    """What is asked for takes PDAL."""


@dataclass(frozen=True)
class Reading:
    """How PDAL reads a kind of file."""

    types: dict[str, np.dtype]  #: the dimensions, in their order
    decoded: dict[
        str, Callable[[RecordFields], NDArray]
    ]  #: of records; those that are read here as PDAL does
    module: dict[str, Any]  #: what a script finds set: `metadata`, `spatialreference`
    log: str  #: what PDAL said


def may_run(stages: Sequence[Mapping[str, Any]]) -> bool:
    """Whether these stages, some of them readers, may be run without PDAL as far as can be told from them."""
    types = [(str(stage.get("type")), stage) for stage in stages]
    return all(
        set(stage) <= _PLAIN if kind == "readers.las" else not kind.startswith(("readers.", "writers."))
        for kind, stage in types
    )


def reading_of(reader: Mapping[str, Any], records: NDArray) -> Reading:
    """How PDAL reads a LAS file that holds `records` and no other points.

    Raises
    ------
    NeedsPdal
        If it cannot, for PDAL to say why.
    """
    seen = FirstSeen()
    try:
        with callbacks.Callbacks() as called:
            log = pdal_env.execute([dict(reader), called.filter(seen.look)], arrays=False).log
    except StageError as error:
        raise NeedsPdal(str(error)) from error
    return seen.reading(records, str(reader["filename"]), log)


class FirstSeen:
    """What PDAL made of some points."""

    def __init__(self) -> None:
        self.found: dict[str, NDArray] = {}
        self.module: dict[str, Any] = {}

    def look(self, given: dict[str, Any], ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
        """A filter's function, for a callback."""
        self.found.update({name: np.array(values) for name, values in ins.items()})
        for name in ("metadata", "spatialreference"):
            self.module[name] = copy.deepcopy(given.get(name))

    def reading(self, records: NDArray, path: str, log: str, added: Collection[str] = ()) -> Reading:
        """How the file at `path` is read, of whose points that were seen the `records` are given.

        `added`: dimensions that the points had, and that come from the file only where its records have them.
        """
        if not self.found or len(self.found["X"]) != len(records):
            raise NeedsPdal("the reader gave no points, or others")
        ways = _ways(records.dtype.names or (), path)
        beside = {name for name in added if name not in ways and name != "Classification"}
        found = {name: values for name, values in self.found.items() if name not in beside}
        decoded = {}
        for name, values in found.items():
            way = ways.get(name)
            if way is None:
                continue
            here = way(records)
            if here.dtype == values.dtype and np.array_equal(here.view(np.uint8), values.view(np.uint8)):
                decoded[name] = way
        types = {name: values.dtype for name, values in found.items()}
        return Reading(types, decoded, self.module, log)


def _ways(fields: Sequence[str], path: str) -> dict[str, Callable[[RecordFields], NDArray]]:
    """Ways of reading dimensions, by PDAL's names, of records with laspy's fields (LAS 1.4 R15, tables 7 to 18)."""
    header = read_header(path)
    assert header is not None

    def scaled(axis: int) -> Callable[[RecordFields], NDArray]:
        field, scale, offset = "XYZ"[axis], header.scales[axis], header.offsets[axis]

        def way(records: RecordFields) -> NDArray:
            values = records[field] * scale
            values += offset
            return values

        return way

    def bits(field: str, first: int, count: int) -> Callable[[RecordFields], NDArray]:
        return lambda records: records[field] >> np.uint8(first) & np.uint8((1 << count) - 1)

    def plain(field: str, dtype: Any = None) -> Callable[[RecordFields], NDArray]:
        return lambda records: np.ascontiguousarray(records[field], dtype)

    ways = {axis: scaled(number) for number, axis in enumerate("XYZ")}
    ways |= {
        "Intensity": plain("intensity"),
        "UserData": plain("user_data"),
        "PointSourceId": plain("point_source_id"),
        "GpsTime": plain("gps_time"),
        **{color.capitalize(): plain(color) for color in ("red", "green", "blue")},
    }
    if "classification_flags" in fields:
        flags = "classification_flags"
        ways |= {
            "ReturnNumber": bits("bit_fields", 0, 4),
            "NumberOfReturns": bits("bit_fields", 4, 4),
            "Classification": plain("classification"),
            "ClassFlags": bits(flags, 0, 4),
            "ScanChannel": bits(flags, 4, 2),
            "ScanDirectionFlag": bits(flags, 6, 1),
            "EdgeOfFlightLine": bits(flags, 7, 1),
            "ScanAngleRank": lambda records: (records["scan_angle"] * 0.006).astype(np.float32),
            "Infrared": plain("nir"),
            **{name: bits(flags, bit, 1) for bit, name in enumerate(pdal_env.FLAGS)},
        }
    else:
        ways |= {
            "ReturnNumber": bits("bit_fields", 0, 3),
            "NumberOfReturns": bits("bit_fields", 3, 3),
            "ScanDirectionFlag": bits("bit_fields", 6, 1),
            "EdgeOfFlightLine": bits("bit_fields", 7, 1),
            "ScanAngleRank": plain("scan_angle_rank", np.float32),
        }
        if not pdal_env.splits_class_flags():  # else a few points do not tell how flags are read
            ways["Classification"] = plain("raw_classification")
    needs = {"GpsTime": "gps_time", "Infrared": "nir", "Red": "red", "Green": "green", "Blue": "blue"}
    ways = {name: way for name, way in ways.items() if needs.get(name, "X") in fields}
    return {name: plain(name) for name, _ in plain_dimensions(path) or () if name in fields} | ways


@dataclass(frozen=True)
class _Part:
    """Points of a file."""

    reading: Reading
    records: RecordFields
    mask: NDArray[np.bool_] | None = None  #: which of them are meant; None for all

    @property
    def count(self) -> int:
        return len(self.records) if self.mask is None else int(np.count_nonzero(self.mask))

    def those(self, mask: NDArray[np.bool_]) -> _Part:
        """Some of the points."""
        if self.mask is not None:
            chosen = self.mask.copy()
            chosen[self.mask] = mask
            mask = chosen
        return _Part(self.reading, self.records, mask)

    def decoded(self, name: str) -> NDArray:
        values = self.reading.decoded[name](self.records)
        return values if self.mask is None else values[self.mask]


class View(Mapping[str, NDArray]):
    """Points as a stage sees PDAL's: dimensions by name. What a file holds is decoded each time that it is asked for."""

    def __init__(self, parts: Sequence[_Part], made: dict[str, NDArray]) -> None:
        self._parts = list(parts)
        self._made = made  #: what stages changed or made
        self._places: dict[str, NDArray] = {}  #: coordinates, which one stage asks for several times
        self.count = sum(part.count for part in self._parts)
        first = self._parts[0].reading
        self._read, self.module = first.types, first.module
        for part in self._parts:
            if part.reading.types != first.types:
                raise NeedsPdal("inputs of several kinds")
            if part.reading.module["spatialreference"] != first.module["spatialreference"]:
                raise NeedsPdal("inputs of several references")

    @classmethod
    def of_file(cls, reading: Reading, records: RecordFields) -> View:
        """All points that a reader would give."""
        return cls([_Part(reading, records)], {})

    @classmethod
    def merged(cls, views: Sequence[View]) -> View:
        """The points of all, one after the other."""
        if len(views) == 1:
            return views[0]
        names = list(views[0]._made)
        if any(list(view._made) != names for view in views):
            names = sorted({name for view in views for name in view._made})
        made = {name: np.concatenate([view[name] for view in views]) for name in names}
        return cls([part for view in views for part in view._parts], made)

    def those(self, mask: NDArray[np.bool_]) -> View:
        """Some of the points."""
        parts, start = [], 0
        for part in self._parts:
            parts.append(part.those(mask[start : start + part.count]))
            start += part.count
        return View(parts, {name: values[mask] for name, values in self._made.items()})

    def __getitem__(self, name: str) -> NDArray:
        if name in self._made:
            return self._made[name]
        if name in self._places:
            return self._places[name]
        if name not in self._read:
            raise KeyError(name)
        if not self._decodes(name):
            raise NeedsPdal(f"the dimension '{name}'")
        decoded = [part.decoded(name) for part in self._parts]
        values = decoded[0] if len(decoded) == 1 else np.concatenate(decoded)
        if name in ("X", "Y", "Z"):
            self._places[name] = values
        return values

    @property
    def changed(self) -> set[str]:
        """Dimensions that stages changed or made."""
        return set(self._made)

    def forget(self) -> None:
        """Let go of coordinates, which are decoded anew for whoever asks."""
        self._places = {}

    def __contains__(self, name: object) -> bool:
        return name in self._made or name in self._read

    def __iter__(self) -> Iterator[str]:
        yield from self._read
        yield from (name for name in self._made if name not in self._read)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def add(self, name: str, kind: str) -> None:
        """A dimension of PDAL's type, 0 where it is new."""
        dtype = number_type(kind)
        if name not in self:
            self._made[name] = np.zeros(self.count, dtype)
        elif name not in self._made and (self._read[name] != dtype or not self._decodes(name)):
            raise NeedsPdal(f"the dimension '{name}'")

    def _decodes(self, name: str) -> bool:
        return all(name in part.reading.decoded for part in self._parts)

    def write(self, outs: Mapping[str, NDArray]) -> None:
        """Take what a filter wrote."""
        for name, values in outs.items():
            there = self._made[name].dtype if name in self._made else self._read.get(name)
            if there != values.dtype or len(values) != self.count:
                raise NeedsPdal(f"what is written to '{name}'")
            self._made[name] = values


def execute(stages: Sequence[dict[str, Any]], read: Mapping[str, View]) -> pdal_env.Execution:
    """Run a lowered pipeline of readers, whose points are given by their tags, and filters of ours.

    Raises
    ------
    NeedsPdal
        Where it takes PDAL.
    StageError
        Of a stage.
    """
    tagged: dict[str, list[View]] = {}
    waiting: list[list[View]] = []  # what no stage has taken yet
    for stage in stages:
        kind = stage["type"]
        if kind == "readers.las":
            views = [read[stage["tag"]]]
        else:
            names = stage.get("inputs")
            if names is None:
                views = [view for given in waiting for view in given]
                waiting = []
            else:
                taken = [tagged[name] for name in ([names] if isinstance(names, str) else names)]
                waiting = [given for given in waiting if not any(given is one for one in taken)]
                views = [view for given in taken for view in given]
            views = _filtered(stage, views)
        waiting.append(views)
        if "tag" in stage:
            tagged[stage["tag"]] = views
    log = "\n".join(dict.fromkeys(part.reading.log for view in read.values() for part in view._parts))
    return pdal_env.Execution(
        count=sum(view.count for given in waiting for view in given), metadata={}, arrays=[], log=log
    )


def _filtered(stage: Mapping[str, Any], views: list[View]) -> list[View]:
    """What a filter makes of views."""
    kind = stage["type"]
    if kind == "filters.merge":
        return [View.merged(views)]
    if kind == "filters.range":
        limits = _LIMITS.fullmatch(str(stage.get("limits")))
        if limits is None or "where" in stage:
            raise NeedsPdal(kind)
        return [view.those(view[limits[1]] <= float(limits[2])) for view in views]
    if kind != "filters.python" or "where" in stage:
        raise NeedsPdal(kind)
    arguments = stage.get("pdalargs", {})
    label = arguments.get("label", "")
    function = callbacks.function_of(label)
    if function is None and runtime.made.get(label) is None:
        raise NeedsPdal(kind)
    for view in views:
        for adds in stage.get("add_dimension", ()):
            view.add(*adds.split("="))
        outs: dict[str, NDArray] = {}
        module = {**view.module, "pdalargs": arguments}
        if function is not None:
            function(module, view, outs)
        else:
            runtime.run_stage(module, view, outs)
            if (failure := runtime.failure_of(label)) is not None:
                raise failure
        view.write(outs)
        view.forget()
    return views
