"""From which friction on a slide chatters by itself: directions, masses, damping, and motions that grow."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control import Robot, load_config
from q2r2_control.benchmark.sliding_stability import chatter_friction
from q2r2_control.types import Array

CONFIG = load_config("config/dual_iiwa7.yaml")
ROBOT = Robot.from_config(CONFIG)
AWAY, TOWARDS, ACROSS = np.array([1.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
PAD, METAL = 1e5, 1e6  # [N/m]
# The left tool at (0.55, 0.4) on the table, pointing down.
PRESSING = np.array([0.35, 0.95, -0.1, -1.35, 0.1, 0.85, 0.3])


def pressing() -> Array:
    q = ROBOT.home.copy()
    q[ROBOT.arms["left"].joints] = PRESSING
    return q


def friction(direction: Array, stiffness: float = PAD, rotor_share: float = 1.0, damping_ratio: float = 1.0) -> float:
    settings = CONFIG.impedance.model_copy(update={"damping_ratio": damping_ratio})
    return chatter_friction(ROBOT, settings, "left", pressing(), direction, stiffness, rotor_share)


def test_only_a_slide_away_from_the_base_chatters() -> None:
    assert friction(AWAY) < 1.2
    assert friction(TOWARDS) == friction(ACROSS) == np.inf


def test_lighter_rotors_more_damping_and_a_softer_contact_bear_more_friction() -> None:
    assert friction(AWAY) < friction(AWAY, rotor_share=0.1)
    assert friction(AWAY) < friction(AWAY, damping_ratio=2.0)
    assert friction(AWAY, METAL) < friction(AWAY, PAD)
    assert friction(AWAY, METAL) > 0.3, "metal on wood"


def test_an_impedance_that_presses_without_friction_is_stable() -> None:
    for direction in (AWAY, TOWARDS, ACROSS):
        assert friction(direction, METAL, damping_ratio=0.1) > 0.0


@pytest.mark.parametrize("scale", [0.1, 10.0])
def test_a_direction_has_no_length(scale: float) -> None:
    assert friction(scale * AWAY) == friction(AWAY)
