"""alsNet on real clouds with fixed training and test parts, beside the forest, and after transfer.

    python benchmarks/alsnet.py --data DIR                               # both scenes, configuration "small"
    python benchmarks/alsnet.py --data DIR --transfer                    # Delft, then a tenth of Montpellier
    python benchmarks/alsnet.py --data DIR --forest                      # the forest on the same parts
    python benchmarks/alsnet.py --kernels                                # where a batch's time goes, memory
    python benchmarks/alsnet.py --train A.laz B.laz --test C.laz --classes '{"2": "Ground", "6": "Building"}' \
        --network '{"configuration": "alsnet4"}'                         # any labeled clouds

DIR (or the environment variable PDAL_STAGES_DATA) is as for benchmarks/classification.py. Scores are over the test
points of the classes trained. Nothing is fitted or chosen on test points: epochs are chosen on blocks of the
training part. Seconds are CPU seconds of the process (all threads) with wall seconds beside them.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import tempfile
import time
from pathlib import Path

import laspy
import numpy as np
from classification import MERGED, SCENES, figures, read, with_height

from pdal_stages.accuracy.measures import Accuracy
from pdal_stages.alsnet import CONFIGURATIONS
from pdal_stages.classifier import Model, TrainingCloud, TrainingOptions, train

#: Side of the squares a tenth of which keeps its labels, meters.
PATCH = 10.0


def clock() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def since(start: tuple[float, float]) -> dict[str, float]:
    return {"wall": round(time.perf_counter() - start[0], 1), "cpu": round(time.process_time() - start[1], 1)}


def cloud_of(data: Path, scene: str, part: str) -> TrainingCloud:
    xyz, labels, dimensions = read(data, scene, part)
    return TrainingCloud(xyz, labels, with_height(xyz, dimensions), name=f"{scene} {part}")


def files_cloud(paths: list[Path], name: str) -> TrainingCloud:
    tiles = [laspy.read(path) for path in paths]
    xyz = np.concatenate([np.column_stack([t.x, t.y, t.z]) for t in tiles])
    known = {
        "Intensity": "intensity",
        "ReturnNumber": "return_number",
        "NumberOfReturns": "number_of_returns",
    }
    dimensions = {
        ours: np.concatenate([np.asarray(t[theirs]) for t in tiles]) for ours, theirs in known.items()
    }
    labels = np.concatenate([np.asarray(t.classification) for t in tiles])
    return TrainingCloud(xyz, labels, with_height(xyz, dimensions), name=name)


def tenth(cloud: TrainingCloud, seed: int = 0) -> TrainingCloud:
    """A tenth of the ground keeps its labels: one in ten squares, drawn at random; all points stay as neighbors."""
    cell = np.floor(cloud.xyz[:, :2] / PATCH).astype(np.int64)
    squares, square = np.unique(cell, axis=0, return_inverse=True)
    chosen = np.random.default_rng(seed).permutation(len(squares))[: max(1, round(len(squares) / 10))]
    mask = np.isin(square.reshape(-1), chosen)
    return TrainingCloud(cloud.xyz, cloud.labels, cloud.dimensions, name=cloud.name, mask=mask)


def area(score: np.ndarray, wrong: np.ndarray) -> float:
    """Chance that a wrong point scores higher than a right one: area under the ROC curve."""
    from scipy.stats import rankdata

    n, m = np.count_nonzero(wrong), np.count_nonzero(~wrong)
    return float((rankdata(score)[wrong].sum() - n * (n + 1) / 2) / (n * m)) if n and m else float("nan")


def judge(model: Model, test: TrainingCloud, merged: dict | None, threads: int, what: str) -> dict:
    start = clock()
    network = model.algorithm.name == "alsnet"
    found = model.predict(test.xyz, test.dimensions, threads=threads, margin=True, variance=network)
    took = since(start)
    codes = [code for code, _ in model.classes]
    labels = np.asarray(test.labels)
    known = np.isin(labels, codes)
    accuracy = Accuracy.from_labels(labels, found.classification, classes=tuple(codes))
    one = tuple(code for code in codes if code not in (3, 4))
    joined = Accuracy.from_labels(labels, found.classification, classes=one, merge=merged)
    wrong = (found.classification != labels)[known]
    out = {
        "what": what,
        **figures(accuracy),
        "f1": {str(one.code): round(100 * (one.f1 or 0.0), 2) for one in accuracy.per_class},
        "merged": figures(joined) if merged else None,
        "confusion": accuracy.matrix.tolist() if hasattr(accuracy, "matrix") else None,
        "test_points": len(labels),
        "classify_seconds": took,
        "errors_found_by": {
            "margin": round(area(-found.margin[known], wrong), 3),
            "reliability": round(area(-found.reliability[known], wrong), 3),
        },
        "report": {k: v for k, v in found.report.figures.items() if k.startswith("batches")},
    }
    if found.variance is not None:
        out["errors_found_by"]["variance"] = round(area(found.variance[known], wrong), 3)
    print(f"\n{what}")
    print(
        f"  OA {out['overall_accuracy']:.2f}  kappa {out['kappa']:.2f}  recall {out['mean_class_recall']:.2f}  "
        f"precision {out['mean_class_precision']:.2f}  F1 {out['mean_f1']:.2f}"
    )
    if merged:
        print(
            f"  merged {merged}: OA {out['merged']['overall_accuracy']:.2f}  F1 {out['merged']['mean_f1']:.2f}"
        )
    print("  F1 by class   " + "  ".join(f"{code}: {value:.2f}" for code, value in out["f1"].items()))
    print(
        f"  classified in {took}; ROC area for errors {out['errors_found_by']}; {out['report']}", flush=True
    )
    return out


def trained(cloud: TrainingCloud, classes, network: dict, args, what: str) -> tuple[Model, dict]:
    start = clock()
    options = TrainingOptions(
        algorithm="alsnet", alsnet=network, dimensions=args.dimensions, classes=classes, seed=args.seed,
        threads=args.threads, voxel=0.0,
    )  # fmt: skip
    model = train([cloud], options, progress=not args.quiet)
    took = since(start)
    notes = model.info["training"]
    for row in notes["curve"][:: max(1, len(notes["curve"]) // 8)]:
        held = (
            f", held out OA {100 * row['overall_accuracy']:.1f} F1 {100 * (row['mean_f1'] or 0):.1f}"
            if "mean_f1" in row
            else ""
        )
        print(f"    epoch {row['epoch']}: loss {row['loss']:.3f}{held}")
    out = {
        "what": what,
        "seconds": took,
        "seconds_an_epoch": {k: round(v / max(notes["epochs"], 1), 2) for k, v in took.items()},
        "parts_wall": model.seconds,
        "batches": notes["batches"],
        "epochs": notes["epochs"],
        "best_epoch": notes["best_epoch"],
        "held_out": notes["held_out"],
        "labeled_points": notes["samples"],
        "spacing": model.algorithm.spacing,
        "halo_m": round(model.halo_m, 1),
        "weights": model.algorithm.to_file([])["parameters"]["weights"],
        "largest_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }
    print(
        f"  {what}: {json.dumps({k: v for k, v in out.items() if k not in ('what', 'held_out')})}", flush=True
    )
    return model, out


def kernels(configuration: str) -> dict:
    """CPU seconds of one batch, part by part, on one thread."""
    from threadpoolctl import threadpool_limits

    from pdal_stages.alsnet.geometry import ball_query, build, farthest_points, scramble, three_nearest
    from pdal_stages.alsnet.weights import Folded, fresh

    one = CONFIGURATIONS[configuration]
    random = np.random.default_rng(0)
    side = (one.points / 15.0) ** 0.5  # 15 points a square meter
    xyz = random.random((one.points, 3)) * [side, side, 10.0]
    build(xyz[:100], np.zeros((100, 1), np.float32), one)  # compile
    out: dict = {"configuration": configuration, "points": one.points}

    def timed(name, call):
        start = time.process_time()
        result = call()
        out[name] = round(time.process_time() - start, 3)
        return result

    with threadpool_limits(1):
        order = timed("order", lambda: scramble(xyz))
        xyz = np.ascontiguousarray(xyz[order])
        level = one.levels[0]
        centers = timed("first farthest points", lambda: farthest_points(xyz, level.centers))
        timed("first balls", lambda: ball_query(xyz, centers, level.radius, level.samples))
        timed("first three nearest", lambda: three_nearest(xyz, xyz[centers]))
        pyramid = timed("whole geometry", lambda: build(xyz, xyz[:, 2:].astype(np.float32), one))
        net = Folded(fresh(one, 1, 5, 0), one)
        timed("network applied", lambda: net(pyramid))
        out["estimated_mb"] = round(one.memory_mb(2))
        out["largest_memory_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    print(json.dumps(out), flush=True)
    return out


def training_step(configuration: str) -> dict:
    """CPU seconds and memory of one training step of one batch, on one thread."""
    import torch

    from pdal_stages.alsnet.geometry import build
    from pdal_stages.alsnet.network import Network, tensors

    torch.set_num_threads(1)
    one = CONFIGURATIONS[configuration]
    random = np.random.default_rng(0)
    side = (one.points / 15.0) ** 0.5
    pyramid = build(
        random.random((one.points, 3)) * [side, side, 10.0], np.zeros((one.points, 2), np.float32), one
    )
    network = Network(one, 2, 5).train()
    labels = torch.from_numpy(random.integers(0, 5, one.points))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    start = time.process_time()
    torch.nn.functional.cross_entropy(network(tensors(pyramid)), labels).backward()
    out = {
        "configuration": configuration,
        "training step": round(time.process_time() - start, 2),
        "memory_mb_more": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024 - before,
    }
    print(json.dumps(out), flush=True)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=os.environ.get("PDAL_STAGES_DATA"))
    parser.add_argument("--scene", nargs="+", choices=sorted(SCENES), default=sorted(SCENES, reverse=True))
    parser.add_argument("--network", type=json.loads, default={}, help="options of the network, as JSON")
    parser.add_argument("--dimensions", nargs="*", default=["HeightAboveGround"])
    parser.add_argument("--transfer", action="store_true", help="Delft, then a tenth of Montpellier's labels")
    parser.add_argument(
        "--transfer-network", type=json.loads, default={}, help="other options for the second part"
    )
    parser.add_argument("--source", type=Path, help="model to transfer from, instead of training on Delft")
    parser.add_argument(
        "--start", choices=("both", "source", "nothing"), default="both", help="what of --transfer"
    )
    parser.add_argument("--forest", action="store_true", help="the forest instead")
    parser.add_argument("--kernels", nargs="*", metavar="CONFIGURATION", help="times of one batch instead")
    parser.add_argument("--train", nargs="+", type=Path, help="labeled LAS or LAZ files instead of a scene")
    parser.add_argument("--test", nargs="+", type=Path)
    parser.add_argument("--classes", type=json.loads)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--save", type=Path, help="folder for the models")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--quiet", action="store_true")
    args = parser.parse_args()
    results = []
    if args.kernels is not None:
        for name in args.kernels or ["tiny", "small", "alsnet4"]:
            results += [kernels(name), training_step(name)]
    elif args.train:
        model, notes = trained(files_cloud(args.train, "train"), args.classes, args.network, args, "files")
        results += [
            notes,
            judge(model, files_cloud(args.test, "test"), None, args.threads, "files, test part"),
        ]
    else:
        if not args.data:
            sys.exit("name the folder of the clouds with --data")
        results = transfer(args) if args.transfer else scenes(args)
    if args.json:
        args.json.write_text(json.dumps(results, indent=1) + "\n")


def scenes(args) -> list[dict]:
    out = []
    for scene in args.scene:
        cloud, test = cloud_of(args.data, scene, "train"), cloud_of(args.data, scene, "test")
        classes = list(SCENES[scene])
        if args.forest:
            options = TrainingOptions(
                dimensions=args.dimensions, classes=classes, seed=args.seed, threads=args.threads
            )
            model = train([cloud], options, progress=not args.quiet)
            what = f"{scene}: forest, {options.neighborhoods}"
        else:
            what = f"{scene}: alsNet, {args.network.get('configuration', 'small')}"
            model, notes = trained(cloud, classes, args.network, args, what)
            out.append(notes)
        if args.save:
            model.save(args.save / f"{scene}-{model.algorithm.name}.model")
        out.append(judge(model, test, MERGED[scene], args.threads, what))
    return out


def transfer(args) -> list[dict]:
    """Montpellier with a tenth of its labels: from Delft's network, and from nothing."""
    with tempfile.TemporaryDirectory() as folder:
        source = args.source or Path(folder) / "delft.model"
        out = []
        if not args.source and args.start != "nothing":
            model, notes = trained(
                cloud_of(args.data, "delft", "train"), list(SCENES["delft"]), args.network, args, "delft"
            )
            model.save(source)
            out.append(notes)
        cloud, test = (
            tenth(cloud_of(args.data, "montpellier", "train")),
            cloud_of(args.data, "montpellier", "test"),
        )
        second = {"validation": 0, "histogram_threshold": 100, **args.network, **args.transfer_network}
        starts = {"source": ("a tenth, after Delft", str(source)), "nothing": ("a tenth, from nothing", None)}
        for kind, (what, start) in starts.items():
            if args.start not in ("both", kind):
                continue
            what = f"montpellier: alsNet, {what}"
            model, notes = trained(
                cloud, list(SCENES["montpellier"]), {**second, "start_from": start}, args, what
            )
            out += [notes, judge(model, test, MERGED["montpellier"], args.threads, what)]
        return out


if __name__ == "__main__":
    main()
