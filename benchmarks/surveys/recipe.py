"""How the shipped models are trained: which copies of which surveys, which features, which forests."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from clouds import SURVEYS, Cloud, load, on_slopes, thinned, without_returns

from pdal_stages.base.hashing import coordinate_hash
from pdal_stages.classifier import Model, TrainingCloud, TrainingOptions, train
from pdal_stages.features.voxels import represent
from pdal_stages.stages.heights import PREPARATION

#: Points per square metre of thinned copies.
DENSITIES = (8.0, 2.0, 0.6)
#: (slope, points per square metre, whether in terraces) of copies on synthetic terrain.
SLOPES = ((0.3, 8.0, False), (0.6, 3.0, False), (0.9, 1.0, False), (0.5, 0.3, False), (0.5, 1.0, True))
#: Samples of each class from each copy.
SAMPLES = 1500

OPTIONS = TrainingOptions(
    neighborhoods="s5,k10,k20,k50",
    feature_set="covariance,Verticality,HeightRange,HeightStd,HeightAboveLowest",
    dimensions=("HeightAboveGround", "Ground", "HeightAboveOpening_5", "HeightAboveOpening_17", "returns"),
    classes={"2": 2, "5": 5, "6": 6},
    count=SAMPLES * 20,
    trees=40,
    min_samples_leaf=10,
    prior_weight=0.0,
    passes=2,
    pass_folds=len(SURVEYS),
    context=("own", "box1", "columnvotes2", "columnvotes8"),
    scale=False,
    folds=0,
    voxel=0.25,
)


def copies(cloud: Cloud) -> Iterator[Cloud]:
    """A survey and its thinned and tilted copies; each once more without return numbers, where it has them."""
    made = [cloud, *(thinned(cloud, density) for density in DENSITIES)]
    for number, (slope, density, terraces) in enumerate(SLOPES):
        steep = on_slopes(cloud, slope, number, terraces)
        made.append(thinned(steep, density) or steep)
    for one in made:
        if one is None:
            continue
        yield one
        if SURVEYS[cloud.survey].returns:
            yield without_returns(one)


def training_cloud(cloud: Cloud) -> TrainingCloud:
    """As dense as it is trained on, with a mask of :data:`SAMPLES` points of each class, chosen by their coordinates."""
    representatives = represent(cloud.xyz, OPTIONS.voxel, cloud.dimensions.values())
    if representatives is not None:
        cloud = cloud.taken(representatives.rows)
    order = np.argsort(coordinate_hash(cloud.xyz, 1), kind="stable")
    mask = np.zeros(len(order), np.bool_)
    for code in (2, 5, 6):
        mask[order[cloud.labels[order] == code][:SAMPLES]] = True
    return TrainingCloud(
        cloud.xyz, cloud.labels, cloud.dimensions, name=cloud.name, mask=mask, survey=cloud.survey
    )


def train_on(data: Path, surveys: Iterable[str], options: TrainingOptions = OPTIONS) -> Model:
    """The model of these surveys."""
    made = [training_cloud(copy) for name in surveys for copy in copies(load(data, name))]
    model = train(made, options)
    model.info["preparation"] = list(PREPARATION)
    return model
