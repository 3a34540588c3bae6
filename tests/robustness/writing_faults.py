"""Commands whose writes fail, run in a process into which faulty.so is loaded; a line of JSON for each on standard output.

Every kind of output there is has a case here: see test_robust_writing.py, which lists kinds from the code.
"""

from __future__ import annotations

import contextlib
import ctypes
import io
import json
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

FAUX = {
    "type": "readers.faux",
    "count": 3000,
    "mode": "ramp",
    "bounds": "([500000,500060],[5400000,5400060],[0,9])",
}
HAG = {"type": "filters.hag_minima"}
WKT = (
    'PROJCS["WGS 84 / UTM zone 32N", GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",9],PARAMETER["scale_factor",0.9996],'
    'PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["metre",1]]'
)
FOREST = {"neighborhoods": "c1", "feature_set": "covariance", "dimensions": [], "count": 50, "trees": 2}
#: Ways of failing, by the numbers that faulty.c knows them by; the last writes a part first.
FAULTS = {"short write": (1,), "disk full": (2,), "disk full once": (3, 5), "I/O error once": (4,)}
OLDER = {".json": b'{"older": 1}\n', ".html": b"<!DOCTYPE html>\n<p>older</p>\n"}


@dataclass
class Case:
    """A command that writes one file.

    Attributes
    ----------
    output : str
        Its name.
    words : callable
        Gives the command's words, from the folder of inputs and the output.
    exact : bool
        Whether the same command writes the same bytes again.
    folder : str
        Where writes fail: below it alone.
    """

    output: str
    words: Callable[[Path, Path], list]
    exact: bool = True
    folder: str = ""

    @property
    def older(self) -> bool:
        """Whether an older file may be there, which is replaced; thresholds would be read."""
        return self.output not in ("in_o.las", "bins.json")


def pdal(output: str, writer: dict, *filters: dict, exact: bool = True) -> Case:
    def words(inputs: Path, target: Path) -> list:
        (inputs / "job.json").write_text(json.dumps([FAUX, *filters, {**writer, "filename": str(target)}]))
        return ["pipeline", inputs / "job.json"]

    return Case(output, words, exact)


def ours(output: str, stage: dict, option: str, exact: bool = True) -> Case:
    def words(inputs: Path, target: Path) -> list:
        (inputs / "job.json").write_text(json.dumps([str(inputs / "in.las"), {**stage, option: str(target)}]))
        return ["pipeline", inputs / "job.json"]

    return Case(output, words, exact)


def tiled(
    output: str, name: str, *flags: str, folder: str = "", exact: bool = True, report: bool = False
) -> Case:
    def words(inputs: Path, target: Path) -> list:
        writer = target.parent.parent / name if report else target.parent / name
        stages = [
            str(inputs / "in.las"),
            HAG,
            {"type": "writers.las", "filename": str(writer), "extra_dims": "all"},
        ]
        (inputs / "job.json").write_text(json.dumps(stages))
        more = ["--report", target] if report else []
        return ["pipeline", inputs / "job.json", "--tile", 30, "--workers", 0, "--retries", 0, *flags, *more]

    return Case(output, words, exact, folder)


def plain(output: str, *words: str, exact: bool = True) -> Case:
    return Case(output, lambda inputs, target: [w.format(inputs=inputs, target=target) for w in words], exact)


def objects(output: str, name: str, folder: str = "") -> Case:
    """Of a layer that has a file of its own, whose name follows from the one given."""
    return Case(
        output,
        lambda inputs, target: ["objects", inputs / "in.las", target.with_name(name), "--cell", 2],
        False,
        folder,
    )


CASES = {
    "writers.las .las": pdal("o.las", {"type": "writers.las"}),
    "writers.las .laz": pdal("o.laz", {"type": "writers.las"}),
    "writers.las .laz 1.4": pdal("o.laz", {"type": "writers.las", "minor_version": 4, "dataformat_id": 6}),
    "records kept": plain("o.laz", "classify", "{inputs}/wkt.laz", "{target}", "--model", "{inputs}/in.model", exact=False),
    "writers.text": pdal("o.txt", {"type": "writers.text"}),
    "writers.text geojson": pdal("o.geojson", {"type": "writers.text", "format": "geojson"}),
    "writers.ply": pdal("o.ply", {"type": "writers.ply"}),
    "writers.ply binary": pdal("o.ply", {"type": "writers.ply", "storage_mode": "little endian"}),
    "writers.bpf": pdal("o.bpf", {"type": "writers.bpf"}),
    "writers.pcd": pdal("o.pcd", {"type": "writers.pcd"}),
    "writers.pcd binary": pdal("o.pcd", {"type": "writers.pcd", "compression": "binary"}),
    "writers.sbet": pdal("o.sbet", {"type": "writers.sbet"}),
    "writers.gltf": pdal("o.glb", {"type": "writers.gltf"}, {"type": "filters.delaunay"}),
    "writers.ogr": pdal("o.geojson", {"type": "writers.ogr"}),
    "writers.ogr shapefile": pdal("o.shp", {"type": "writers.ogr"}),
    "writers.gdal": pdal("o.tif", {"type": "writers.gdal", "resolution": 1, "output_type": "mean"}),
    "model": ours("o.model", {"type": "writers.classifiermodel", **FOREST}, "filename", exact=False),
    "adapted model": plain(
        "o.model", "adapt", "{inputs}/in.las", "--model", "{target}", "--teacher", "{inputs}/in.model", "--sure", "0", exact=False
    ),
    "thresholds": ours("bins.json", {"type": "filters.multiscalefeatures", "neighborhoods": "c1", "feature_set": "D1"}, "bins"),
    "accuracy json": ours("o.json", {"type": "filters.accuracy", "reference": "Classification", "ignore": []}, "json"),
    "accuracy html": ours("o.html", {"type": "filters.accuracy", "reference": "Classification", "ignore": []}, "html", exact=False),
    "metadata": plain("o.json", "pipeline", "{inputs}/plain.json", "--metadata", "{target}", exact=False),
    "expanded pipeline": plain("o.json", "expand", "{inputs}/plain.json", "-o", "{target}", exact=False),
    "model page": plain("o.html", "model", "{inputs}/in.model", "--html", "{target}", exact=False),
    "town": plain("o.laz", "town", "{target}", "--size", "30", "--density", "2", exact=False),
    "objects .geojson": objects("o_buildings.geojson", "o.geojson"),
    "objects .gpkg": plain("o.gpkg", "objects", "{inputs}/in.las", "{target}", exact=False),
    "objects: what a run keeps": objects("o_buildings.geojson", "o.geojson", ".o.geojson.cells"),
    "metadata of classify": plain(
        "o.json", "classify", "{inputs}/in.las", "{inputs}/classified.las", "--model", "{inputs}/in.model", "--metadata", "{target}",
        exact=False,
    ),
    "classify in tiles: what a run keeps": Case(
        "o.las",
        lambda inputs, target: ["classify", inputs / "in.las", target, "--model", inputs / "in.model", "--tile", 30, "--workers", 0],
        False,
        ".pdal-stages",
    ),
    "train in tiles": Case(
        "o.model",
        lambda inputs, target: ["train", inputs / "in.las", "--model", target, "--tile", 30, "--workers", 0, "--count", 50, "--trees", 2, "--neighborhoods", "c1", "--feature-set", "covariance"],
        False,
        ".pdal-stages-train",
    ),
    "tiles: output of a file": tiled("in_o.las", "#_o.las"),
    "tiles: output of a tile": tiled("499980_5400000_o.las", "#_o.las", "--per", "tile", exact=False),
    "tiles: what a run keeps": tiled("in_o.las", "#_o.las", folder=".pdal-stages"),
    "tiles: report .json": tiled("report/o.json", "#_o.las", folder="report", exact=False, report=True),
    "tiles: report .html": tiled("report/o.html", "#_o.las", folder="report", exact=False, report=True),
}  # fmt: skip


def prepare(inputs: Path) -> None:
    """Inputs of the cases."""
    import laspy
    import numpy as np

    import pdal_stages as ps

    inputs.mkdir()
    rng = np.random.default_rng(0)
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 0.01), [500_000, 5_400_000, 0]
    las = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(2000, header=header))
    las.x, las.y = rng.uniform(0, 59.9, (2, 2000)) + np.array([[500_000], [5_400_000]])
    las.z = np.where(las.x > 500_030, 5.0, 0.0)
    las.classification = np.where(las.x > 500_030, 6, 2)
    las.write(inputs / "in.las")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = las.header.scales, las.header.offsets
    header.global_encoding.wkt = True
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(WKT))
    named = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(2000, header=header))
    named.x, named.y, named.z, named.classification = las.x, las.y, las.z, las.classification
    named.write(inputs / "wkt.laz")
    (inputs / "plain.json").write_text(json.dumps([str(inputs / "in.las"), HAG]))
    ps.run_pipeline(
        [
            str(inputs / "in.las"),
            {"type": "writers.classifiermodel", "filename": str(inputs / "in.model"), **FOREST},
        ]
    )


def run(words: list) -> tuple[int, str]:
    """The command in this process: its code, and what it said on standard error."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        words = list(map(str, words))
        try:
            if words[0] == "town":
                from pdal_stages.synthetic import main

                code = main(words[1:])
            else:
                from pdal_stages.cli import main

                code = main(words)
        except SystemExit as end:
            code = int(end.code or 0)
    return int(code or 0), said.getvalue()


def main() -> None:
    root, answers = Path(sys.argv[1]), os.fdopen(os.dup(1), "w")
    sys.__stdout__ = sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    shim = ctypes.CDLL(None)
    shim.faulty.argtypes = [ctypes.c_char_p, ctypes.c_long, ctypes.c_int]
    prepare(root / "inputs")
    for name, case in CASES.items():
        folder = root / "out"

        def attempt(kind: int, after: int, older: bool, case=case, folder=folder) -> dict:
            shutil.rmtree(folder, ignore_errors=True)
            target = folder / case.output
            target.parent.mkdir(parents=True)
            if older and case.older:
                target.write_bytes(OLDER.get(target.suffix, b""))
            shim.faulty(os.fsencode(folder / case.folder), after, kind)
            code, said = run(case.words(root / "inputs", target))
            hits = shim.faulty_hits()
            shim.faulty(b"/nowhere", 0, 0)
            return {
                "code": code,
                "said": said,
                "hits": hits,
                "content": target.read_bytes().hex() if target.exists() else None,
                "left": [p.name for p in folder.rglob(".pdal-stages-partial-*")],
            }

        good = attempt(0, 0, False)
        size = len(good["content"] or "") // 2
        print(json.dumps({"case": name, "kind": "", "exact": case.exact, **good}), file=answers, flush=True)
        for kind, number in ((kind, number) for kind, numbers in FAULTS.items() for number in numbers):
            for after in sorted({0, size // 2, max(0, size - 1)}):
                result = attempt(number, after, kind == "disk full")
                print(
                    json.dumps({"case": name, "kind": kind, "after": after, **result}),
                    file=answers,
                    flush=True,
                )


if __name__ == "__main__":
    main()
