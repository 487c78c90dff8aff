"""Boxes that something may press into: smaller boxes within a round skin, so that cores stay apart where bodies touch.

Directions between two bodies are known as long as their cores, the segments and boxes without their radii, do not meet.
A finger's core is less than a centimetre below its skin. Where a body may get inside a box by a depth, the box is
measured as its core, smaller by that depth on all sides, and a radius. On its faces nothing changes; edges and corners
become round, which is right only for pairs that are allowed to touch: a body of radius r that comes diagonally gets
deeper into the real corner than the depth, by r (1 - 1 / sqrt(3)) at most, 4 mm for the fingers of a Hand-E.
"""

from __future__ import annotations

import numpy as np

from q2r2_control.control.geometry.collision import CollisionBodies, CollisionModel
from q2r2_control.types import Array

# Of half a box's thickness: what its skin takes at most.
_THICKEST_SKIN = 0.9


def with_rounded_boxes(model: CollisionModel, depth: Array) -> CollisionModel:
    """A model whose pairs with ``depth`` (p,) [m] above 0 see a box rounded by that much, or by as much as it is thick.

    Every other pair sees the boxes as they are. Pairs keep their order.
    """
    bodies, pairs = model.bodies, model.pairs
    second = pairs.second.copy()
    sources: list[int] = []
    skins: list[float] = []
    for p in np.flatnonzero((depth > 0.0) & (bodies.box[second] == 1)):
        box = int(second[p])
        skin = min(float(depth[p]), _THICKEST_SKIN * float(bodies.half[box].min()))
        if (box, skin) not in zip(sources, skins, strict=True):
            sources.append(box)
            skins.append(skin)
        second[p] = len(bodies.joint) + list(zip(sources, skins, strict=True)).index((box, skin))
    if not sources:
        return model
    half = bodies.half[sources] - np.array(skins)[:, None]
    size = np.linalg.norm(half, axis=1) + skins
    rounded = {"radius": np.array(skins), "half": half, "size": size}
    joined = {
        name: np.concatenate([array, rounded.get(name, array[sources])]) for name, array in bodies._asdict().items()
    }
    return model._replace(bodies=CollisionBodies(**joined), pairs=pairs._replace(second=second))


def deeper_at_corners(model: CollisionModel, kept: Array) -> Array:
    """How much deeper than -``kept`` (p,) [m] pairs that may touch can get into a real corner (p,) [m]; else 0."""
    boxed = (kept < 0.0) & (model.bodies.box[model.pairs.second] == 1)
    return np.where(boxed, (1.0 - 1.0 / np.sqrt(3.0)) * model.bodies.radius[model.pairs.first], 0.0)


def deepest(model: CollisionModel, radius: Array) -> Array:
    """How far the two bodies of each pair may get into each other until their cores meet (p,) [m].

    ``radius`` (g,) are the least that the bodies ever have [m].
    """
    return radius[model.pairs.first] + radius[model.pairs.second]
