"""How the shipped models are trained: copies of surveys, features, forests."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from clouds import Cloud, load, one_return, thinned, without_returns
from surveys import BUILDING, FEW, GROUND, SHRUBS, SURVEYS, VEGETATION

from pdal_stages import Model, TrainingCloud, TrainingOptions, train
from pdal_stages.base.hashing import hash_rows
from pdal_stages.features.voxels import represent
from pdal_stages.stages.preprocessing import PREPARATION

#: Points per square meter of thinned copies.
DENSITIES = (8.0, 2.0, 0.6)
#: Points per square meter, at most, of copies that have one return of each pulse, the first or the
#: last.
ONE_RETURN = (12.0, 3.0)
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
OPTIONS = TrainingOptions(
    neighborhoods="k20,k50",
    feature_set="covariance,Verticality,HeightRange,HeightStd,HeightAboveLowest,"
    "NormalAgreement_k20,SurfaceVariationMin_k20",
    dimensions=(
        "HeightAboveGround",
        "Ground",
        "HeightAboveOpening_5",
        "HeightAboveOpening_17",
        "returns",
    ),
    classes={"2": 2, "3,5": 5, "6": 6},
    count=40_000,
    trees=40,
    max_samples=1.0,
    min_samples_leaf=10,
    prior_weight=0.0,
    passes=2,
    context=("own", "box1", "box4", "columnvotes2", "columnvotes4", "segments6"),
    folds=0,
    voxel=0.25,
)


def copies(cloud: Cloud) -> Iterator[Cloud]:
    """Yield a survey and its thinned copies.

    Where it has return numbers, each comes once more without these, and there are copies with one
    return of each pulse.
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


def training_cloud(cloud: Cloud, number: int) -> TrainingCloud:
    """Return a survey's copy of this number as it is trained on: a square, with a mask of samples.

    The mask has as many points of each class as the survey gives from a copy, chosen by their
    coordinates.
    """
    representatives = represent(cloud.xyz, OPTIONS.voxel, cloud.dimensions.values())
    if representatives is not None:
        cloud = cloud.taken(representatives.rows)
    few = SURVEYS[cloud.survey].samples == FEW
    cloud = cloud.taken(square(cloud, MOST_OF_FEW if few else MOST, number))
    order = np.argsort(hash_rows(cloud.xyz.T, 1), kind="stable")
    mask = np.zeros(len(order), np.bool_)
    whole = TrainingCloud(
        cloud.xyz, cloud.labels, cloud.dimensions, name=cloud.name, survey=cloud.survey
    )
    usable = np.where(contradicted(cloud), 0, cloud.labels)
    samples = dict.fromkeys((GROUND, VEGETATION, BUILDING), SURVEYS[cloud.survey].samples)
    for code, most in {**samples, SHRUBS: SHRUB_SAMPLES}.items():
        mask[order[usable[order] == code][:most]] = True
    return replace(whole, mask=mask)


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
    as there are any. The square lies inside the cloud where it fits.
    """
    if len(cloud.xyz) <= most:
        return np.arange(len(cloud.xyz))
    codes = [code for code in (6, 5, 2) if (cloud.labels == code).any()]
    labeled = np.flatnonzero(cloud.labels == codes[number % len(codes)])
    order = np.argsort(hash_rows(cloud.xyz[labeled].T, 7), kind="stable")
    center = cloud.xyz[labeled[order[number * 17 % len(labeled)]], :2]
    low, high = cloud.xyz[:, :2].min(axis=0), cloud.xyz[:, :2].max(axis=0)
    half = 0.5 * np.sqrt(most / max(cloud.density, 1e-3))
    middle = 0.5 * (low + high)
    center = np.clip(center, np.minimum(low + half, middle), np.maximum(high - half, middle))
    away = np.abs(cloud.xyz[:, :2] - center).max(axis=1)
    return np.sort(np.argsort(away, kind="stable")[:most])


def training_clouds(data: Path, survey: str) -> list[TrainingCloud]:
    """Return the copies of a survey that are trained on."""
    return [training_cloud(copy, number) for number, copy in enumerate(copies(load(data, survey)))]


def train_on(data: Path, surveys: Iterable[str], options: TrainingOptions = OPTIONS) -> Model:
    """Return the model of these surveys."""
    model = train([one for name in surveys for one in training_clouds(data, name)], options)
    model.record_preprocessing(PREPARATION)
    return model
