"""`classify` of one file and of many: outputs, dimensions, COPC."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from block_scene import QUICK_TRAINING, ground_and_block

from pdal_stages.base.errors import PipelineError
from pdal_stages.cli import main
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.pipeline.inputs_outputs import outputs_of

pytestmark = pytest.mark.pdal


@pytest.fixture(scope="module")
def folder(tmp_path_factory, write_las):
    """Three clouds, the first with an extra dimension, and a model."""
    base = tmp_path_factory.mktemp("many")
    (base / "in").mkdir()
    for number in range(3):
        arrays = ground_and_block(500, seed=number)
        if number == 0:
            arrays["Amplitude"] = arrays["X"].astype("f4")
        write_las(base / "in" / f"t{number}.laz", arrays, point_format=1)
    train = ["train", str(base / "in" / "t0.laz"), "--model", str(base / "m.model")]
    heights = "--writers.classifiermodel.dimensions=HeightAboveGround"
    assert main([*train, *QUICK_TRAINING, heights]) == 0
    return base


@pytest.fixture()
def classify(folder, run):
    def go(*words):
        words = words if "--workers" in words else (*words, "--workers", 0)
        return run("classify", *words, "--model", folder / "m.model", "--no-progress")

    return go


def files_in(folder, pattern="*"):
    return sorted(path.name for path in folder.glob(pattern) if path.is_file())


@pytest.mark.parametrize(
    ("given", "output", "workers", "names"),
    [
        ("in", "out", 0, ["t0.laz", "t1.laz", "t2.laz"]),
        ("in/t[12].laz", "out/c_#.las", 2, ["c_t1.las", "c_t2.las"]),
        ("in/t[12].laz", "out/#", 0, ["t1.laz", "t2.laz"]),
    ],
)
def test_an_output_for_each_input(folder, classify, tmp_path, given, output, workers, names):
    if "#" in output:  # only a folder that is named is made
        (tmp_path / "out").mkdir()
    code, out, err = classify(folder / given, tmp_path / output, "--workers", workers)
    assert code == 0, err
    assert files_in(tmp_path / "out") == names
    assert all(name in out for name in names)
    for name in names:
        written = np.asarray(laspy.read(tmp_path / "out" / name).classification)
        assert len(written) == 500 and set(np.unique(written)) == {2, 6}


@pytest.mark.parametrize("output", ["out.laz", "out.txt", "out/"])
def test_points_are_counted_where_pdal_writes_them(folder, classify, tmp_path, output):
    options = ["--writers.las.scale_x=0.05"] if output != "out.txt" else []
    code, out, err = classify(folder / "in" / "t1.laz", f"{tmp_path}/{output}", *options)
    assert code == 0 and "500 points" in out, out + err


@pytest.mark.parametrize("words", [(), ("--per", "tile"), ("--dry-run",)])
def test_a_dimension_that_cannot_be_written_is_refused_before_any_tile(
    folder, classify, tmp_path, words
):
    las = laspy.read(folder / "in" / "t1.laz")
    las.add_extra_dim(laspy.ExtraBytesParams("Reliability", "u1"))
    (tmp_path / "in").mkdir()
    las.write(tmp_path / "in" / "odd.laz")
    code, out, err = classify(tmp_path / "in", tmp_path / "out/", "--tile", 20, *words)
    assert code == 1 and "odd.laz: the input has a dimension 'Reliability'" in err, err
    assert not out and not (tmp_path / "out").exists()


@pytest.mark.parametrize("way", ["tiles", "pipeline", "train"])
def test_a_dimension_that_one_input_lacks_is_not_taken_for_zero(
    folder, classify, tmp_path, run, way
):
    dimensions = "--writers.classifiermodel.dimensions=HeightAboveGround,Amplitude"
    words = ["train", folder / "in" / "t0.laz", "--model", tmp_path / "m", *QUICK_TRAINING]
    assert run(*words, dimensions)[0] == 0
    if way == "tiles":
        code, _, err = run(
            *("classify", folder / "in", tmp_path / "out/", "--tile", 20, "--workers", 0),
            *("--model", tmp_path / "m"),
        )
    elif way == "pipeline":
        readers = [str(folder / "in" / f"t{number}.laz") for number in (1, 0)]
        heights = {"type": "filters.hag_minima"}
        model = {"type": "filters.modelclassifier", "model": str(tmp_path / "m")}
        stages = [*readers, heights, model, str(tmp_path / "o.las")]
        (tmp_path / "job.json").write_text(json.dumps(stages))
        code, _, err = run("pipeline", tmp_path / "job.json")
    else:
        words[1] = folder / "in"
        code, _, err = run(*words, dimensions)
    assert code == 1 and "'Amplitude' is missing in " in err and "t1.laz without it" in err, err


def test_several_inputs_are_not_merged_into_one(folder, classify, tmp_path):
    code, _, err = classify(folder / "in", tmp_path / "all.laz")
    assert code == 1 and "#" in err and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("given", "output", "names"),
    [("in/t[01].laz", "a/b", ["t0.laz", "t1.laz"]), ("in/t0.laz", "new.d/", ["t0.laz"])],
)
def test_the_output_folder_is_made(folder, classify, tmp_path, given, output, names):
    code, _, err = classify(folder / given, f"{tmp_path}/{output}")
    assert code == 0, err
    assert files_in(tmp_path / output) == names


@pytest.mark.parametrize("words", [["--filters.modelclassifier.no=1"], ["--where", "No > 1"]])
@pytest.mark.parametrize("how", [[], ["--tile", 5]])
def test_what_is_refused_leaves_no_folder(folder, classify, tmp_path, words, how):
    code, _, err = classify(folder / "in/t0.laz", f"{tmp_path}/a/b", *words, *how)
    assert code == 1 and ("no option 'no'" in err or "dimension 'No'" in err), err
    assert not list(tmp_path.iterdir())


def test_a_file_where_the_folder_should_be(folder, classify, tmp_path):
    (tmp_path / "a").write_text("a file")
    for output in ("a/b", "a/"):
        code, _, err = classify(folder / "in", f"{tmp_path}/{output}")
        assert code == 1 and "folder" in err and "t0.laz written" not in err


def test_inputs_of_one_name_are_refused(folder, classify, tmp_path):
    (tmp_path / "t0.laz").write_bytes((folder / "in/t0.laz").read_bytes())
    code, _, err = classify(folder / "in", tmp_path / "t0.laz", f"{tmp_path}/out/")
    assert code == 1 and "two inputs have the same name" in err and "folder" in err
    code, _, err = classify(folder / "in", f"{folder}/in/")
    assert code == 1 and "one of the inputs" in err
    code, output, err = classify(folder / "in", folder / "in" / "t0.laz", tmp_path / "other")
    assert code == 0 and "3 files written" in output, err  # one that is named twice is read once


def test_a_suffix_that_pdal_does_not_know(folder, classify, tmp_path):
    code, _, err = classify(folder / "in/t0.laz", tmp_path / "out.lax")
    assert code == 1 and "out.lax" in err and "Is the suffix mistyped (.laz, .las)?" in err
    code, _, err = classify(folder / "in/t0.laz", tmp_path / "out.tif")
    assert code == 1 and "classify writes points" in err and "pdal-stages objects" in err


def test_metadata_of_many(folder, classify, tmp_path):
    (tmp_path / "bad.laz").write_bytes(b"LASF")
    words = (folder / "in", tmp_path / "bad.laz", tmp_path / "out")
    code, out, err = classify(*words, "--metadata", tmp_path / "m.json")
    assert code == 1 and "bad.laz" in err and "3 files written, 1 failed" in out, err
    data = json.loads((tmp_path / "m.json").read_text())
    names = [Path(entry["input"]).name for entry in data["outputs"]]
    assert names == ["t0.laz", "t1.laz", "t2.laz", "bad.laz"]
    for entry in data["outputs"][:3]:
        assert entry["written"] == 500 and sum(entry["classes"].values()) == 500
    assert data["outputs"][3]["state"] == "failed" and "bad.laz" in data["failures"][0]["what"]


def test_tiles_are_refused_where_nothing_can_be_cut(folder, classify, tmp_path):
    rows = laspy.read(folder / "in" / "t0.laz").xyz
    for number in range(2):
        np.savetxt(tmp_path / f"t{number}.txt", rows, delimiter=",", header="X,Y,Z", comments="")
    for known, words in (("*.txt", []), ("t0.txt", ["--resume"])):
        code, _, err = classify(tmp_path / known, tmp_path / "o.txt", *words)
        assert code == 1 and "t0.txt" in err and "pdal translate" in err
        assert not files_in(tmp_path, "o*")
    assert classify(tmp_path / "t0.txt", tmp_path / "o.txt")[0] == 0


def test_tiles_say_what_has_no_class_as_one_piece_does(folder, classify, tmp_path, write_las):
    """Points without a class from the model, or with one mended: each once, although tiles overlap."""
    las = laspy.read(folder / "in" / "t0.laz")
    codes = np.array(las.classification)
    codes[::9], codes[1::11] = 7, 12
    arrays = {"X": las.x, "Y": las.y, "Z": las.z, "Classification": codes}
    source = write_las(tmp_path / "in.las", arrays, point_format=6)
    options = ("--where", "X < 25", "--filters.modelclassifier.reject_below=0.97", "--no-noise")
    counts, classes = [], []
    for words in ((), ("--tile", "10"), ("--tile", "10", "--per", "tile")):
        (tmp_path / "out").mkdir(exist_ok=True)
        target = tmp_path / "out" / ("#.laz" if words else "o.laz")
        code, out, err = classify(source, target, *options, *words)
        assert code == 0, err
        lines = [line for line in out.splitlines() if line.startswith("  ")]
        classes.append({line.strip() for line in lines if line[:5].strip().isdecimal()})
        counts.append([line for line in lines if not line[:5].strip().isdecimal()])
        numbers = [int(line.split()[-1].replace(",", "")) for line in classes[-1]]
        assert sum(numbers) == len(las.points)
    assert counts[0] == counts[1] == counts[2] and classes[0] == classes[1] == classes[2]
    for text in ("rejected as unreliable", "noise and withheld", "class kept", "outside where"):
        assert text in "\n".join(counts[0]), counts[0]


@pytest.mark.parametrize(("where", "said"), [("Z > 1000", True), ("X < 7", False)])
def test_a_where_that_chooses_nothing_is_said_once(folder, classify, tmp_path, where, said):
    """The second chooses nothing in some tiles alone."""
    words = ("--tile", "10", "--where", where)
    code, _, err = classify(folder / "in" / "t1.laz", tmp_path / "o.laz", *words)
    reported = [line for line in err.splitlines() if "'where' matches no points" in line]
    assert code == 0 and len(reported) == said, err
    assert all(where in line and "PdalStages" not in line for line in reported)


@pytest.mark.parametrize(
    ("words", "made"),
    [
        ((), ["Amplitude", "HeightAboveGround", "Reliability"]),
        (("--dimensions", "none"), ["Amplitude"]),
        (("--dimensions", "Margin,Probability_6"), ["Amplitude", "Margin", "Probability_6"]),
    ],
)
def test_dimensions_are_chosen(folder, classify, tmp_path, words, made):
    code, _, err = classify(folder / "in" / "t0.laz", tmp_path / "o.laz", *words)
    assert code == 0, err
    extra = laspy.read(tmp_path / "o.laz").point_format.extra_dimensions
    assert sorted(d.name for d in extra) == made and all(d.dtype == np.float32 for d in extra)


def test_a_dimension_that_is_not_made(folder, classify, tmp_path):
    source = folder / "in" / "t0.laz"
    code, _, err = classify(source, tmp_path / "o.laz", "--dimensions", "Reliabilty")
    assert code == 1 and "Did you mean 'Reliability'" in err
    code, _, err = classify(source, tmp_path / "o.ply", "--dimensions", "none")
    assert code == 1 and "--dimensions is for LAS" in err


def test_octrees_are_called_alike_in_one_piece_and_in_tiles():
    """But for a folder, where one piece stays an octree if this PDAL can write one."""
    assert outputs_of(["in/a.copc.laz"], "o/#", copc=True) == ["o/a.copc.laz"]
    assert outputs_of(["in/a.copc.laz"], "o/#") == ["o/a.laz"]
    assert outputs_of(["in/a.copc.laz"], "c_#.las", copc=True) == ["c_a.las"]
    both = ["in/a.copc.laz", "in/a.laz"]
    assert outputs_of(both, "o/c_#.laz") == ["o/c_a_copc.laz", "o/c_a.laz"]
    with pytest.raises(PipelineError, match="the same name"):
        outputs_of(["in/a.laz", "other/a.laz"], "o/c_#.laz")


def test_copc_or_a_refusal(folder, classify, tmp_path, capsys):
    out = tmp_path / "o.copc.laz"
    code, _, err = classify(folder / "in" / "t0.laz", out)
    if not pdal_env.knows_copc():
        assert code == 1 and "PDAL 2.4 or later" in err and not out.exists()
        return
    assert code == 0, err
    with laspy.open(out) as reader:
        assert reader.header.vlrs[0].user_id == "copc"
    plain = f'["{folder}/in/t0.laz", {{"type": "writers.las", "filename": "{out}"}}]'
    (tmp_path / "job.json").write_text(plain)
    assert main(["pipeline", str(tmp_path / "job.json")]) == 1
    assert "writers.copc" in capsys.readouterr().err


@pytest.mark.parametrize("tile", [(), ("--tile", 500)])
def test_points_beyond_the_box_of_the_header(folder, classify, tmp_path, tile):
    """LAZ has no checksums: PDAL may decode a damaged file to points anywhere, without an error."""
    content = bytearray((folder / "in/t0.laz").read_bytes())
    (highest_x,) = struct.unpack_from("<d", content, 179)
    struct.pack_into("<d", content, 179, highest_x - 5.0)
    (tmp_path / "odd.laz").write_bytes(content)
    code, _, err = classify(tmp_path / "odd.laz", tmp_path / "out.laz", *tile)
    assert code == 0 and "odd.laz: points lie outside the bounding box in the header" in err, err
