"""A motion is a step and the stop after it. The kernels get it as velocities, and tests as dense samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from q2r2_control.control.safety.stop_rollout import OWN, write_stop
from q2r2_control.types import Array
from tests.control.cells import kernel_model

ACCELERATION = 10.0
H = 0.002
DENSE = 500  # Number of samples of a motion.


@dataclass(frozen=True)
class Motion:
    """A step and the stop after it: the posture and the velocities at the step, and the decelerations in the stop."""

    q: Array
    v: Array
    v_next: Array
    deceleration: Array

    @property
    def q_next(self) -> Array:
        return np.asarray(self.q + 0.5 * H * (self.v + self.v_next))

    def step(self) -> Array:
        t = np.linspace(0.0, H, DENSE // 25)[:, None]
        return np.asarray(self.q + self.v * t + 0.5 * (self.v_next - self.v) / H * t**2)

    def stop(self, samples: int = DENSE) -> Array:
        t = np.linspace(0.0, np.max(np.abs(self.v_next) / self.deceleration), samples)[:, None]
        ran = np.minimum(t, np.abs(self.v_next) / self.deceleration)
        return np.asarray(self.q_next + self.v_next * ran - np.sign(self.v_next) * self.deceleration * ran**2 / 2)


def motion_of(name: str, q: Array, v: Array, v_next: Array, shape: int = OWN) -> Motion:
    deceleration = np.zeros(14)
    write_stop(kernel_model(name).safety, q + 0.5 * H * (v + v_next), v_next, shape, deceleration)
    return Motion(q, v, v_next, deceleration)
