"""Arms that slide along each other do so smoothly: what a row of the QP looks at does not alternate between ticks."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot, load_config
from q2r2_control.benchmark.motion_run import JOLT, count_jolts
from q2r2_control.types import Array
from q2r2_control.verification.contract import Contract

DT = 0.001  # [s]
TICKS = 4000
STARTED = 2.0  # the slide has begun, and the targets' jump is over [s]
FEW = 0.01  # of the ticks: a new pair that comes to hold the arms may still make a jolt

Target = tuple[tuple[float, float, float], tuple[float, float, float]]

# Where each tool is asked to be [m], and how far it is turned from home about which axis [rad].
SLIDES: dict[str, tuple[Target, Target]] = {
    "while a joint is at its limit": (
        ((0.294, 0.219, 0.473), (-0.609, -0.206, 0.149)),
        ((0.304, 0.259, 0.473), (0.322, 0.045, -0.311)),
    ),
    "nearest at the start of a stop or at its end": (
        ((0.469, -0.247, 0.276), (-0.079, -0.212, 0.297)),
        ((0.692, 0.218, 0.481), (0.286, 0.246, -0.527)),
    ),
    "opening and closing in turns": (
        ((0.636, -0.095, 0.429), (0.569, 0.232, -0.051)),
        ((0.52, 0.16, 0.625), (0.088, 0.338, -0.022)),
    ),
    "along a way that is hardly bent": (
        ((0.596, -0.232, 0.439), (-0.009, -0.584, -0.269)),
        ((0.454, 0.15, 0.336), (0.538, 0.283, -0.147)),
    ),
}


@pytest.mark.parametrize("slide", SLIDES)
def test_joints_hardly_jolt_while_arms_slide_along_each_other(slide: str) -> None:
    config = load_config("config/dual_iiwa7.yaml")
    settings = config.control.model_copy(update={"solve_time_limit": None})  # no outcome hangs on the clock
    controller = CartesianController(Robot.from_config(config), settings)
    contract = Contract(controller, controller.robot.home)
    home = {arm: controller.tool_pose(arm) for arm in ("left", "right")}
    targets = {
        arm: pin.SE3(pin.exp3(np.array(turn)) @ home[arm].rotation, np.array(place))
        for arm, (place, turn) in zip(home, SLIDES[slide], strict=True)
    }
    v: list[Array] = []
    for _ in range(TICKS):
        reference = controller.step(targets, DT)
        contract.check(reference, DT)
        v.append(reference.v)
    moving = np.linalg.norm(v[round(STARTED / DT) :], axis=1)
    assert moving.min() > 0.05, "they slide all the time"
    assert count_jolts(np.array(v), DT, STARTED) <= FEW * (TICKS - STARTED / DT), (
        f"changes of more than {JOLT:g} rad/s^2"
    )
