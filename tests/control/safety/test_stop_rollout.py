from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.control.safety.stop_rollout import ARM_BY_ARM, OWN, TOGETHER, brake, write_stop
from tests.control.cells import cell, kernel_model, random_posture

MODEL, RANDOM = kernel_model("dual_iiwa7").safety, np.random.default_rng(5)
GROUPS = {OWN: np.arange(14), ARM_BY_ARM: MODEL.arm, TOGETHER: np.zeros(14)}


@pytest.mark.parametrize("shape", GROUPS)
def test_joints_that_stop_together_come_to_rest_at_the_same_time_except_joints_near_a_limit(shape: int) -> None:
    limits, groups, deceleration = MODEL.limits, GROUPS[shape], np.zeros(14)
    for _ in range(50):
        q, v = random_posture(cell("dual_iiwa7").robot, RANDOM), RANDOM.uniform(-1.0, 1.0, 14)
        own = np.abs(v) / limits.acceleration
        shared = np.abs(v) / [own[groups == group].max() for group in groups]
        room = np.where(v > 0.0, limits.upper - q, q - limits.lower) - limits.longest_step * np.abs(v)
        least = np.divide(0.5 * v**2, room, out=np.full(14, np.inf), where=room > 0.0)
        write_stop(MODEL, q, v, shape, deceleration)
        np.testing.assert_allclose(deceleration, np.minimum(np.maximum(shared, least), limits.acceleration), rtol=1e-12)
        for t in (0.0, 0.02, 0.2):
            ran, (q_out, v_out) = np.minimum(t, np.abs(v) / deceleration), np.zeros((2, 14))
            brake(q, v, deceleration, t, q_out, v_out)
            np.testing.assert_allclose(q_out, q + v * ran - 0.5 * np.sign(v) * deceleration * ran**2, atol=1e-14)
            np.testing.assert_allclose(v_out, v - np.sign(v) * deceleration * ran, atol=1e-14)
