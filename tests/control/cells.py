"""Two cells as arrays for the kernels, and functions that measure distances along motions of their robots."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.geometry.collision import (
    CollisionBodies,
    CollisionData,
    CollisionModel,
    Pairs,
    collision_model_of,
    update_placements,
)
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.geometry.pair_distance import at_least, measure
from q2r2_control.control.jit import kernel
from q2r2_control.control.kernel_model import KernelData, KernelModel, kernel_model_of
from q2r2_control.control.kernel_pointers import KernelPointer, KernelPointers, pointer_to
from q2r2_control.control.safety.speed_bound import update_body_velocities
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_Tuple = TypeVar("_Tuple")
NAMES = ("dual_iiwa7", "dual_panda")


class _Behind(KernelPointer):
    """A pointer to a named tuple, through which Python can read the attributes of the tuple too."""

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.value, name)
        if isinstance(found, tuple):
            found = behind(found)
            setattr(self, name, found)
        return found


def behind(value: _Tuple) -> _Tuple:
    """Return an object that kernels take as a pointer to ``value``, and that Python can use like ``value``.

    The controller passes its data in the same way. If kernels took the named tuple itself, compiling would take a
    minute.
    """
    pointer = pointer_to(value)
    return cast("_Tuple", _Behind(pointer.value, pointer.memory, pointer.numba_type))


class CellArrays(NamedTuple):
    """A robot and the arrays that the collision kernels read."""

    robot: Robot
    collision: CollisionModel

    @property
    def bodies(self) -> CollisionBodies:
        return self.collision.bodies

    @property
    def pairs(self) -> Pairs:
        return self.collision.pairs


@cache
def cell(name: str) -> CellArrays:
    """Return the cell called ``name``, one of ``NAMES``. Each cell is loaded once."""
    robot = Robot.from_config(pandas() if name == "dual_panda" else load_config(f"config/{name}.yaml"))
    return arrays_of(robot)


def arrays_of(robot: Robot) -> CellArrays:
    return CellArrays(robot, behind(collision_model_of(robot)))


@cache
def kernel_model(name: str) -> KernelModel:
    """Return the kernels' model of the cell called ``name``, with the default settings."""
    return behind(kernel_model_of(cell(name).robot, ControllerSettings()))


def kernel_data(name: str, q: Array, v: Array | None = None) -> KernelData:
    """Return kernel data with bodies and joint frames placed at the posture ``q`` (nv,), with the velocity ``v`` (nv,).

    Nothing else is computed.
    """
    data = behind(KernelData.empty(kernel_model(name)))
    move_data(name, data, q, v)
    return data


def move_data(name: str, data: KernelData, q: Array, v: Array | None = None) -> None:
    """Place bodies and joint frames of ``data`` at ``q`` (nv,), with the velocity ``v`` (nv,).

    Tests reuse data in this way because making new data takes 10 ms.
    """
    model, safety = kernel_model(name).safety, data.safety
    safety.state.q[:] = q
    safety.state.v[:] = 0.0 if v is None else v
    update_placements(model.collision, safety.collision, safety.state.q)
    update_body_velocities(model.collision, safety.collision, safety.state.v, safety.velocities)


def reused_data(name: str, q: Array, v: Array | None = None) -> KernelData:
    """Return what :func:`kernel_data` returns. The data that an earlier call for this cell returned are overwritten.

    A test that needs the data of one state at a time saves most of its time in this way.
    """
    data, made = _reused(name)
    for array, content in made:
        array[...] = content
    move_data(name, data, q, v)
    return data


@cache
def _reused(name: str) -> tuple[KernelData, list[tuple[Array, Array]]]:
    """Make kernel data once for each cell. Return them, and all their arrays, each with a copy of its first content."""
    new = KernelData.empty(kernel_model(name))
    return behind(new), [(array, array.copy()) for array in _arrays_in(new)]


def _arrays_in(value: Any) -> Iterator[Array]:
    """Yield all arrays in a named tuple, and all arrays to which its pointers lead."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, KernelPointer):
        yield from _arrays_in(value.value)
    elif isinstance(value, KernelPointers):
        yield from _arrays_in(tuple(value.pointers))
    elif isinstance(value, tuple):
        for part in value:
            yield from _arrays_in(part)


def pandas() -> Config:
    """Return the configuration of a cell with two Panda arms and a table in front of them."""
    arms = {
        side: {
            "model": "example-robot-data:panda",
            "mount": {"position": [0.0, y, 0.0]},
            "home": [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785],
        }
        for side, y in (("left", 0.4), ("right", -0.4))
    }
    table = {"shape": "box", "size": [0.8, 1.6, 0.04], "position": [0.75, 0.0, 0.0]}
    return Config.model_validate({"name": "pandas", "arms": arms, "obstacles": {"table": table}})


def random_posture(robot: Robot, random: np.random.Generator) -> Array:
    """Return random joint positions within the limits (nv,)."""
    return random.uniform(robot.position_lower, robot.position_upper)


def placed(cell: CellArrays, q: Array) -> CollisionData:
    """Return the poses of joint frames and geometries in the world frame at ``q`` (nv,)."""
    data = behind(CollisionData.empty(cell.collision))
    update_placements(cell.collision, data, q)
    return data


def distances(cell: CellArrays, motion: Array, exact_below: float = np.inf, pairs: IntArray | None = None) -> Array:
    """Return the distance of every pair (s, p) [m], or of ``pairs`` (p,), at every posture of ``motion`` (s, nv).

    Pairs that are clearly farther apart than ``exact_below`` get a lower bound instead, which saves most of the time.
    """
    asked = np.arange(len(cell.pairs.first)) if pairs is None else pairs
    out = np.zeros((len(motion), len(asked)))
    _measure_all(cell.collision, behind(CollisionData.empty(cell.collision)), motion, exact_below, asked, out)
    return out


@kernel
def _measure_all(
    model: CollisionModel, data: CollisionData, motion: Array, exact_below: float, pairs: IntArray, out: Array
) -> None:
    for i in range(motion.shape[0]):
        update_placements(model, data, motion[i])
        for k in range(pairs.shape[0]):
            out[i, k] = at_least(model, data, pairs[k])
            if out[i, k] < exact_below:
                out[i, k] = measure(model, data, pairs[k])
