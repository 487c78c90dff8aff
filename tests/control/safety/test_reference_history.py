"""The bounds on the past motion of the reference hold at the postures in its history and between them."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.control.safety.reference_history import look_back, remember, rest_always, turning
from tests.control.cells import NAMES, cell, kernel_data, kernel_model

H = 0.02  # Duration of a step, so long that joints move far between two kept postures [s].
WINDOW = 0.08  # [s]
DENSE = np.linspace(0.0, H, 21)


@pytest.mark.parametrize("name", NAMES)
def test_no_joint_was_farther_from_its_present_position_during_the_window_than_the_bounds_say(name: str) -> None:
    random, robot = np.random.default_rng(3), cell(name).robot
    model, limit = kernel_model(name).safety, robot.velocity_limit
    data = kernel_data(name, robot.home).safety
    history = data.history
    for _ in range(20):
        q, v, times, positions = robot.home.copy(), np.zeros(robot.model.nv), [], []
        history.window[1] = WINDOW
        rest_always(history, q)
        v_next = 0.05 * random.uniform(-limit, limit)
        for step in range(8):
            remember(history, q, v, v_next, H)
            times.append(step * H + DENSE)
            positions.append(q + np.outer(DENSE, v) + np.outer(0.5 * DENSE**2, (v_next - v) / H))
            q, v = positions[-1][-1], v_next
            # Some joints swing to and fro, so they are at the same position at each tick and elsewhere between ticks.
            v_next = -v if random.uniform() < 0.5 else 0.05 * random.uniform(-limit, limit)
        look_back(model.collision, history, q, v)
        age = times[-1][-1] - np.concatenate(times)
        inside = age <= WINDOW
        away = np.concatenate(positions)[inside] - q
        travel, off = np.abs(away).max(axis=0), np.abs(away + np.outer(age[inside], v)).max(axis=0)
        assert (history.travel >= travel - 1e-12).all()
        assert (history.off >= off - 1e-12).all()
        assert (history.travel <= 3.0 * travel + 1e-6).all(), "the bound is not far too large"


def test_if_the_window_was_0_a_longer_window_is_unknown_at_first_and_each_step_adds_to_the_known_part() -> None:
    robot, data = cell(NAMES[0]).robot, kernel_data(NAMES[0], cell(NAMES[0]).robot.home).safety
    history, still = data.history, np.zeros(robot.model.nv)
    history.window[1] = WINDOW
    rest_always(history, robot.home)
    assert history.window[0] == WINDOW
    for window, known in ((0.0, 0.0), (WINDOW, H), (WINDOW, 2.0 * H)):
        history.window[1] = window
        remember(history, robot.home, still, still, H)
        assert history.window[0] == known


@pytest.mark.parametrize("name", NAMES)
def test_the_turning_of_a_joint_depends_on_the_motions_of_all_joints_between_the_base_and_this_joint(name: str) -> None:
    motion = np.random.default_rng(4).uniform(0.0, 1.0, cell(name).robot.model.nv)
    for joint, carriers in enumerate(cell(name).robot.model.supports):
        if joint == 0:
            continue
        before = sum(motion[carrier - 1] for carrier in carriers if carrier not in (0, joint))
        expected = motion[joint - 1] * (motion[joint - 1] + 2.0 * before)
        assert turning(kernel_model(name).safety.collision, motion, joint - 1) == pytest.approx(expected)
