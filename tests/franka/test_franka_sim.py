"""Two simulated FR3 behind the real client library. franka-sim judges the commands. It is not part of this project."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.types import CommandMode
from tests.franka.simulated_arms import ADDRESSES, SimulatedArm, why_not
from tests.franka.soak import CELL, ENDS, run_slowly

pytestmark = pytest.mark.skipif(why_not() is not None, reason=f"no arm can be simulated: {why_not()}")
SLOWNESS = 3.0
PATIENCE = 60.0  # [s]


@pytest.mark.parametrize("mode", [CommandMode.POSITION, CommandMode.TORQUE])
def test_no_session_has_a_reflex_or_violates_a_limit_however_it_ends(mode: CommandMode) -> None:
    found = run_slowly("--sessions", str(len(ENDS)), "--mode", mode, slowness=SLOWNESS)
    assert found["failure"] == ""
    assert found["ends"] == dict.fromkeys(ENDS, 1)
    assert found["reflexes"] == []
    assert found["violated"] == {"left": [], "right": []}


@pytest.mark.slow
@pytest.mark.parametrize("mode", [CommandMode.POSITION, CommandMode.TORQUE])
def test_arms_follow_the_handover_and_stacking_trajectory_without_a_reflex(mode: CommandMode) -> None:
    found = run_slowly("--trajectory", "handover+stack", "--mode", mode, slowness=SLOWNESS)
    assert found["failure"] == ""
    assert found["reflexes"] == []
    assert found["violated"] == {"left": [], "right": []}


def wait_until(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_hand_grasps_the_object_between_its_fingers_and_opens_again(tmp_path: Path) -> None:
    from q2r2_franka.hand import Hand
    from q2r2_franka.settings import HandSettings

    arm = SimulatedArm("left", load_config(CELL).arms["left"].home, tmp_path, 1.0)
    hand = Hand("left", ADDRESSES["left"], HandSettings())
    try:
        wait_until(lambda: hand.opening is not None)
        hand.command(0.0)
        wait_until(lambda: hand.opening == pytest.approx(0.5, abs=0.02))  # The object is half as wide as the open hand.
        hand.command(1.0)
        wait_until(lambda: hand.opening == pytest.approx(1.0, abs=0.02))
    finally:
        hand.close()
        arm.kill()
