"""Work motions can be followed: they begin at home, have no jumps, keep their speed bounded, and end at rest."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.benchmark.work_motions import ARMS, REST, WORK_MOTIONS, WorkMotion, motions_named
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

DT = 0.001
FASTEST, STRONGEST = 0.55, 5.0  # Largest speed [m/s] and acceleration [m/s^2] of a target.


@pytest.fixture(scope="module")
def start() -> dict[str, pin.SE3]:
    robot = Robot.from_config(load_config("config/dual_iiwa7.yaml"))
    return {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}


def ways(motion: WorkMotion, start: dict[str, pin.SE3]) -> Array:
    """Return the positions (n, arms, 3) of the targets at every tick."""
    ticks = range(round(motion.ends / DT))
    return np.array([[pose.translation for pose in motion.targets(tick * DT, start).values()] for tick in ticks])


@pytest.mark.slow
@pytest.mark.parametrize("motion", WORK_MOTIONS.values(), ids=WORK_MOTIONS)
def test_targets_begin_at_home_and_move_smoothly_at_bounded_speed_and_end_at_rest(
    motion: WorkMotion, start: dict[str, pin.SE3]
) -> None:
    way = ways(motion, start)
    v = np.diff(way, axis=0) / DT
    a = np.diff(v, axis=0) / DT
    np.testing.assert_allclose(way[0], [start[arm].translation for arm in ARMS], atol=1e-12)
    assert np.linalg.norm(v, axis=2).max() <= FASTEST
    assert np.linalg.norm(a, axis=2).max() <= STRONGEST
    still = np.arange(len(way)) * DT >= motion.ends - REST
    np.testing.assert_array_equal(way[still], np.broadcast_to(way[-1], way[still].shape))
    began = round(motion.begins / DT)
    np.testing.assert_allclose(v[began - 200 : began], 0.0, atol=1e-6)
    assert np.abs(v[began:]).max() > 0.03


@pytest.mark.slow
@pytest.mark.parametrize(("gap", "speed"), [(0.40, 0.15), (0.20, 0.50), (0.16, 0.04)])
def test_a_carrying_motion_keeps_the_distance_and_the_speed_that_its_name_states(
    gap: float, speed: float, start: dict[str, pin.SE3]
) -> None:
    motion = WORK_MOTIONS[f"carry-{gap:.2f}-{speed:.2f}"]
    carried = ways(motion, start)[round(motion.begins / DT) :]
    np.testing.assert_allclose(carried[:, 0] - carried[:, 1], np.tile([0.0, gap, 0.0], (len(carried), 1)), atol=1e-12)
    # The motion along x has the whole speed, and the motion up and down has half of it.
    assert np.abs(np.diff(carried[:, 0, 0])).max() / DT == pytest.approx(speed, rel=1e-3)
    np.testing.assert_allclose(carried[-1], carried[0], atol=1e-9)


def test_motions_are_found_by_their_names_and_by_the_beginnings_of_their_names() -> None:
    assert [motion.name for motion in motions_named(["swap", "pass", "pass"])] == ["pass", "pass-back", "swap"]
    assert {motion.name for motion in motions_named(["carry-0.16"])} == {
        f"carry-0.16-{speed}" for speed in ("0.04", "0.15", "0.30", "0.50")
    }
    assert motions_named(WORK_MOTIONS) == tuple(WORK_MOTIONS.values())
    for name in ("carr", "", "Meet"):
        with pytest.raises(ConfigError, match=f"motion '{name}': allowed: carry-0.40-0.15, .*stretch"):
            motions_named(["meet", name])
