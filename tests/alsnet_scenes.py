"""Small labeled scenes and untrained networks for the tests of alsNet. No PyTorch."""

import numpy as np

from pdal_stages.alsnet.classifier import AlsNet
from pdal_stages.alsnet.configuration import Configuration, Level
from pdal_stages.alsnet.network import initial_weights

TINY = Configuration(
    "test",
    256,
    (Level(64, 1.5, 8, (16, 16, 32), (32, 32)), Level(16, 4.0, 8, (32, 32, 64), (32, 32))),
    head=(32,),
    dropout=0.0,
)


def scene(n=3000, side=24.0, seed=0, origin=(0.0, 0.0, 0.0)):
    """Ground, a flat roof 4 m above it and a tree's crown: (xyz, labels, dimensions)."""
    random = np.random.default_rng(seed)
    xy = random.random((n, 2)) * side
    z = random.normal(0.0, 0.02, n)
    labels = np.full(n, 2, np.uint8)
    roof = (xy[:, 0] % 12 < 5) & (xy[:, 1] % 12 < 5)
    tree = (xy[:, 0] % 12 > 7) & (xy[:, 1] % 12 > 7)
    z[roof] += 4.0
    z[tree] += random.uniform(1.0, 6.0, np.count_nonzero(tree))
    labels[roof], labels[tree] = 6, 5
    xyz = np.round(np.column_stack([xy, z]), 3) + np.asarray(origin)
    intensity = random.integers(0, 200, n).astype(np.uint16)
    return xyz, labels, {"Intensity": intensity, "HeightAboveGround": z}


def random_net(inputs=("Z",), classes=3, configuration=TINY, spacing=3.0, seed=0):
    """A network whose weights are random, normalizations included."""
    random = np.random.default_rng(seed)
    weights = initial_weights(configuration, len(inputs), classes, seed)
    for name, array in weights.items():
        if name != "scores":
            array[:, -4:] = random.uniform(0.5, 1.5, (len(array), 4))
    weights["scores"] *= np.float32(0.1)  # so that probabilities are neither 0 nor 1
    return AlsNet(
        weights,
        configuration,
        tuple(inputs),
        (0.0,) * len(inputs),
        (1.0,) * len(inputs),
        spacing,
        classes,
    )


def model_of(net, codes=(2, 5, 6)):
    """A network as a model, as training would leave it."""
    from test_classifier_modelfile import manifest

    from pdal_stages.classifier.model import Model

    classes = [
        {**manifest()["classes"][0], "code": c, "name": str(c), "labels": [c]} for c in codes
    ]
    info = {**manifest(), "classes": classes, "passes": [{"importances": None}]}
    return Model((net,), [(c, str(c)) for c in codes], info)


def coverage(batches):
    """Batches each point is in."""
    members = [batches.members(number) for number in range(len(batches))]
    return np.bincount(np.concatenate(members))
