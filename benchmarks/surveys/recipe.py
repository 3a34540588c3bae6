"""How the shipped models are trained: copies of surveys, features, forests."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from zlib import crc32

import numpy as np
from clouds import Cloud, load, one_return, thinned, with_skin, without_returns
from lines import STRIPS, Implant, LabeledLine, labeled_line, string_line
from scipy.spatial import cKDTree
from surveys import (
    BUILDING,
    FEW,
    FOREST,
    GROUND,
    SHRUBS,
    SLOPE,
    SURVEYS,
    TOWER,
    VEGETATION,
    WIRE,
)

from pdal_stages import Model, TrainingCloud, TrainingOptions, train
from pdal_stages.base.hashing import hash_rows
from pdal_stages.features.voxels import represent
from pdal_stages.stages.preprocessing import PREPARATION

#: Points per square meter of thinned copies.
DENSITIES = (8.0, 2.0, 0.6)
#: Points per square meter, at most, of copies that have one return of each pulse, the first or the
#: last.
ONE_RETURN = (12.0, 3.0)
#: The same of copies of woods that end where only the skin of crowns was seen.
SKIN_DENSITIES = (8.0, 2.0)
#: Height in meters below which a label of something standing is not believed, and above which a
#: label of ground is not (not tuned): rocks that the filter cuts off taught that roofs may be
#: ground.
BELOW, ABOVE = 0.3, 1.5
#: Points of a copy at most: a square of it, each copy's somewhere else, wide enough for whole
#: houses.
MOST = 45_000
#: The same of surveys that give few samples.
MOST_OF_FEW = 16_000
#: Samples of shrubs from each copy, at most (not tuned).
SHRUB_SAMPLES = 250
#: The same of wires and of towers: as many as these are of each class, with those of others 40,000,
#: keep false wires rare (docs/trials.md).
WIRE_SAMPLES, TOWER_SAMPLES = 30, 6
#: Points per square meter of the thinnest copies that have these: in thinner ones a wire is a few
#: points that could be anything.
LINE_DENSITY = 1.5
#: Samples of a copy beside those that its survey gives: of vegetation and of building that look
#: like wires, each, and of vegetation that looks like roofs. They lie higher than
#: :data:`SHAPED_HEIGHT` meters, and their 20 neighbors on a line or in a plane.
SHAPED_SAMPLES, SHAPED_HEIGHT, LEAST_SHAPE = 200, 3.0, 0.6
#: Heights that models read.
HEIGHTS = ("HeightAboveGround", "HeightAboveOpening_5", "HeightAboveOpening_17")
#: Features of 20 and of 50 neighbors.
WIDE = (
    *("Linearity", "Planarity", "Scattering", "Omnivariance", "Anisotropy", "Eigenentropy"),
    *("EigenvalueSum", "SurfaceVariation", "Verticality", "HeightRange", "HeightStd"),
    "HeightAboveLowest",
)
#: Features of 8 neighbors, for wires: those of 20 reach what is beside a sparse one.
NARROW = ("Linearity", "HeightRange", "EigenvalueSum", "SurfaceVariation")
OPTIONS = TrainingOptions(
    neighborhoods="k8,k20,k50",
    feature_set=(
        *(f"{name}_k8" for name in NARROW),
        *(f"{name}_{token}" for token in ("k20", "k50") for name in WIDE),
        *("NormalAgreement_k20", "SurfaceVariationMin_k20"),
    ),
    dimensions=("HeightAboveGround", "Ground", *HEIGHTS[1:], "returns", "GapBelow"),
    classes={"2": 2, "3,5": 5, "6": 6, "14": 14, "15": 15},
    count=40_000,
    trees=40,
    max_samples=1.0,
    min_samples_leaf=10,
    prior_weight=0.0,
    passes=2,
    context=("own", "box1", "box4", "columnvotes2", "columnvotes4", "segments6", "lines14"),
    lines=(WIRE,),
    fill_up=False,
    folds=0,
    voxel=0.25,
)


def copies(cloud: Cloud) -> Iterator[Cloud]:
    """Yield a survey and its thinned copies.

    Where it has return numbers, each comes once more without these, and there are copies with one
    return of each pulse. Woods come with an edge, too.
    """
    made = [cloud, *(thinned(cloud, density) for density in DENSITIES)]
    for one in made:
        if one is None:
            continue
        yield one
        if SURVEYS[cloud.survey].returns:
            yield without_returns(one)
    if SURVEYS[cloud.survey].returns:
        for density in ONE_RETURN:
            for last in (False, True):
                yield one_return(thinned(cloud, density) or cloud, last)
    if SURVEYS[cloud.survey].landscape in (FOREST, SLOPE):
        for density in SKIN_DENSITIES:
            yield with_skin(thinned(cloud, density) or cloud)


def squares(data: Path, survey: str) -> list[Cloud]:
    """Return the parts of a survey's copies that are trained on, one point for each voxel."""
    known, out = SURVEYS[survey], []
    most = MOST_OF_FEW if known.samples == FEW else MOST
    for cloud in copies(load(data, survey)):
        representatives = represent(cloud.xyz, OPTIONS.voxel, cloud.dimensions.values())
        if representatives is not None:
            cloud = cloud.taken(representatives.rows)
        for _ in range(known.squares):
            out.append(cloud.taken(square(cloud, most, len(out))))
    return out


def training_cloud(cloud: Cloud) -> TrainingCloud:
    """Return a square with a mask of samples.

    The mask has as many points of each class as the survey gives from a copy, chosen by their
    coordinates.
    """
    order = np.argsort(hash_rows(cloud.xyz.T, 1), kind="stable")
    mask = np.zeros(len(order), np.bool_)
    whole = TrainingCloud(
        cloud.xyz, cloud.labels, cloud.dimensions, name=cloud.name, survey=cloud.survey
    )
    usable = np.where(contradicted(cloud), 0, cloud.labels)
    samples = dict.fromkeys((GROUND, VEGETATION, BUILDING), SURVEYS[cloud.survey].samples)
    samples[SHRUBS] = SHRUB_SAMPLES
    if cloud.density >= LINE_DENSITY:
        samples |= {WIRE: WIRE_SAMPLES, TOWER: TOWER_SAMPLES}
    for code, most in samples.items():
        mask[order[usable[order] == code][:most]] = True
    tree = cKDTree(cloud.xyz)
    high = cloud.dimensions["HeightAboveGround"][order] > SHAPED_HEIGHT
    for code, planar in ((VEGETATION, False), (BUILDING, False), (VEGETATION, True)):
        rows = order[high & (usable[order] == code)]
        mask[choose_shaped(cloud.xyz, tree, rows, planar)] = True
    return replace(whole, mask=mask)


def choose_shaped(xyz: np.ndarray, tree: cKDTree, rows: np.ndarray, planar: bool) -> np.ndarray:
    """Return the first :data:`SHAPED_SAMPLES` of the rows (m,) whose neighbors lie along a line.

    With `planar`, they are those whose neighbors lie in a plane.
    """
    out: list[np.ndarray] = []
    for part in np.array_split(rows, max(1, len(rows) // 1000)):
        if not len(part) or sum(map(len, out)) >= SHAPED_SAMPLES or len(xyz) < 20:
            break
        near = xyz[tree.query(xyz[part], 20)[1]]
        near -= near.mean(axis=1, keepdims=True)
        low, middle, high = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", near, near)).T
        shape = middle - low if planar else high - middle
        out.append(part[shape > LEAST_SHAPE * high])
    return np.concatenate([np.zeros(0, np.int64), *out])[:SHAPED_SAMPLES]


def contradicted(cloud: Cloud | TrainingCloud) -> np.ndarray:
    """Return which points (n,) have a label that their height contradicts.

    They are labeled as standing, but are Ground and below :data:`BELOW` (feet of walls, courtyards),
    or labeled ground, but above :data:`ABOVE` (rocks).
    """
    height = np.asarray(cloud.dimensions["HeightAboveGround"])
    low = (height < BELOW) & (np.asarray(cloud.dimensions["Ground"]) > 0)
    stands = np.isin(cloud.labels, (4, 5, 6))
    return (low & stands) | ((height > ABOVE) & (cloud.labels == GROUND))


def square(cloud: Cloud, most: int, number: int) -> np.ndarray:
    """Return rows, ascending, of a square of at most `most` points around a labeled point.

    The `number` of a copy decides around which: a building, vegetation and ground in turn, as far
    as there are any; or wires alone, where these are labeled. The square lies inside the cloud where it fits.
    """
    if len(cloud.xyz) <= most:
        return np.arange(len(cloud.xyz))
    wanted = (WIRE,) if (cloud.labels == WIRE).any() else (BUILDING, VEGETATION, GROUND)
    codes = [code for code in wanted if (cloud.labels == code).any()]
    labeled = np.flatnonzero(cloud.labels == codes[number % len(codes)])
    order = np.argsort(hash_rows(cloud.xyz[labeled].T, 7), kind="stable")
    center = cloud.xyz[labeled[order[number * 17 % len(labeled)]], :2]
    low, high = cloud.xyz[:, :2].min(axis=0), cloud.xyz[:, :2].max(axis=0)
    half = 0.5 * np.sqrt(most / max(cloud.density, 1e-3))
    middle = 0.5 * (low + high)
    center = np.clip(center, np.minimum(low + half, middle), np.maximum(high - half, middle))
    away = np.abs(cloud.xyz[:, :2] - center).max(axis=1)
    return np.sort(np.argsort(away, kind="stable")[:most])


def with_line(cloud: Cloud, line: LabeledLine, number: int) -> Cloud:
    """Return a square with a line across it, made of the strip that :func:`strip_of` names."""
    ground = cloud.xyz[:, 2] - cloud.dimensions["HeightAboveGround"]
    seed = (crc32(cloud.survey.encode()), number)
    strips = (strip_of(number),)
    return set_in(cloud, string_line(line, strips, cloud.xyz, ground, cloud.density, seed))


def set_in(cloud: Cloud, implant: Implant) -> Cloud:
    """Return a cloud with the points of an implant.

    Their heights are above the surfaces of the nearest point in plan. They have return numbers
    where the cloud has any.
    """
    heights = {name: np.asarray(cloud.dimensions[name]) for name in HEIGHTS}
    near = cKDTree(cloud.xyz[:, :2]).query(implant.xyz[:, :2])[1]
    has_returns = bool(np.any(cloud.dimensions["NumberOfReturns"]))
    count = np.where(implant.several, 2, 1) * has_returns
    added = {
        **{
            name: implant.xyz[:, 2] - (cloud.xyz[near, 2] - values[near])
            for name, values in heights.items()
        },
        "Ground": np.zeros(len(near)),
        "ReturnNumber": np.minimum(count, 1),
        "NumberOfReturns": count,
    }
    dimensions = {
        name: np.concatenate([values, added[name].astype(values.dtype)])
        for name, values in cloud.dimensions.items()
    }
    return replace(
        cloud,
        xyz=np.concatenate([cloud.xyz, implant.xyz]),
        labels=np.concatenate([cloud.labels, implant.labels]),
        truth=np.concatenate([cloud.truth, implant.labels]),
        dimensions=dimensions,
    )


def strip_of(number: int) -> int:
    """Return the strip of the labeled line that the square of this number has wires of."""
    return number % STRIPS


def training_clouds(data: Path, survey: str) -> list[TrainingCloud]:
    """Return the copies of a survey that are trained on."""
    clouds, line = squares(data, survey), labeled_line(data)
    if not SURVEYS[survey].tells(WIRE):
        clouds = [
            with_line(cloud, line, number) if cloud.density >= LINE_DENSITY else cloud
            for number, cloud in enumerate(clouds)
        ]
    return [training_cloud(cloud) for cloud in clouds]


def train_on(data: Path, surveys: Iterable[str], options: TrainingOptions = OPTIONS) -> Model:
    """Return the model of these surveys."""
    model = train([one for name in surveys for one in training_clouds(data, name)], options)
    model.record_preprocessing(PREPARATION)
    return model
