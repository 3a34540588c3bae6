"""What truly stands in a generated town: every building, tree, wire and bridge, as it was built."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdal_stages.synthetic.districts import Footprint, Site, filled_site
from pdal_stages.synthetic.town import ORIGIN, SPAN
from pdal_stages.synthetic.townplan import block_at, plan_town


class House(NamedTuple):
    """A part of a building under one roof."""

    corners: (
        NDArray  # (4, 2): of the roof, overhang and all, in order; meters, the town's coordinates
    )
    eave: float  # its height, absolute
    ridge: float
    walls: NDArray  # (4, 2): corners of the walls
    #: of a sloped roof's planes: fall along the length, fall along the width, height in the middle
    slopes: tuple

    def height(self, places: NDArray) -> NDArray[np.float64]:
        """Height of the roof at places (n, 2), without dormers, chimneys and the like."""
        along, across = self.walls[0] - self.walls[1], self.walls[1] - self.walls[2]
        away = places - self.walls.mean(axis=0)
        p, q = away @ along / np.hypot(*along), away @ across / np.hypot(*across)
        planes = [middle - fall_p * p - fall_q * q for fall_p, fall_q, middle in self.slopes]
        return np.min([np.full(len(places), self.ridge), *planes], axis=0)


class Tree(NamedTuple):
    """A tree as it was planted; from the air its top may lie a little beside its trunk."""

    x: float
    y: float
    height: float
    radius: float  # of the crown


class TrueObjects(NamedTuple):
    """The things of a town whose place (trees) or any corner (others) lies inside its square."""

    houses: list[House]
    trees: list[Tree]
    decks: NDArray  # (n, 4, 2): corners


def true_objects(size: float, seed: int) -> TrueObjects:
    """Return the objects of a town of `size` meters, in its coordinates (meters)."""
    plan, half = plan_town(seed), size / 2
    square = np.array([(p * half, q * half) for p in (-1, 1) for q in (-1, 1)]) @ plan.turn
    low, high = square.min(axis=0) - SPAN, square.max(axis=0) + SPAN
    (i0, j0, _), (i1, j1, _) = block_at(*low, plan), block_at(*high, plan)

    def placed(site: Site, ab: list[tuple[float, float]]) -> NDArray:
        uv = np.array(ab, float).reshape(-1, 2) + np.array([site.u0, site.v0])
        return uv @ plan.turn.T + half + ORIGIN[:2]

    def inside(places: NDArray) -> bool:
        away = np.abs(places - ORIGIN[:2] - half)
        return bool((away <= half).all(axis=1).any())

    houses, trees, decks = [], [], []
    for i, j in itertools.product(range(i0, i1 + 1), range(j0, j1 + 1)):
        site = filled_site(plan, i, j)
        for kind, *what in site.built:
            if kind == "house":
                base, overhang, eave, top, cuts = what
                z = ORIGIN[2]
                roof, walls = (
                    placed(site, _corners(base, p, q))
                    for p, q in ((overhang / 2, overhang), (0, 0))
                )
                if inside(roof):
                    slopes = tuple((p, q, height + z) for p, q, height in cuts)
                    houses.append(House(roof, eave + z, top + z, walls, slopes))
            elif kind == "tree":
                a, b, height, radius = what
                place = placed(site, [(a, b)])
                if inside(place):
                    trees.append(Tree(float(place[0, 0]), float(place[0, 1]), height, radius))
            elif kind == "deck":
                corners = placed(site, _corners(*what))
                if inside(corners):
                    decks.append(corners)
    return TrueObjects(houses, trees, np.array(decks).reshape(-1, 4, 2))


def _corners(base: Footprint, wider_l: float = 0, wider_w: float = 0) -> list[tuple[float, float]]:
    """Return the corners of a footprint, in order, with its half sides made longer."""
    half_l, half_w = base.half_l + wider_l, base.half_w + wider_w
    return [base.place(p * half_l, q * half_w) for p, q in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
