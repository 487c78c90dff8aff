"""The report of headset-check names the direction of each hand's movement, and gives advice if data are missing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.teleop import Stance
from q2r2_control.inputs.headset import HeadsetServer
from q2r2_control.inputs.headset_check import (
    HandMovement,
    HeadsetCheck,
    advice,
    advice_on_some,
    needed_topics,
    watch_headset,
)
from q2r2_control.inputs.session import HeadsetStatistics
from q2r2_control.teleop.crossed_hands import CrossedHands
from q2r2_control.types import HandSample
from tests.support.fake_headset import FakeHeadset
from tests.support.headset_server import IDENTITY

WORLD = ("+x", "+y", "+z")
UNITY = ("+z", "-x", "+y")
NOBODY = HeadsetStatistics(("127.0.0.1", 10000), None, None, {}, {}, (), (), 0, None)


def moved(axes: tuple[str, str, str], way: tuple[float, float, float], duration: float = 0.4) -> HandMovement:
    movement = HandMovement(axes)
    for fraction in np.linspace(0.0, 1.0, 31):
        position = np.array([0.3, 0.2, 1.1]) + fraction * np.array(way)
        movement.add(HandSample("left", position, np.array([0.0, 0.0, 0.0, 1.0]), 5.0 + duration * fraction))
    return movement


@pytest.mark.parametrize(
    ("axes", "way", "words"),
    [
        (WORLD, (0.1, 0.02, 0.0), "forward +x"),
        (WORLD, (0.0, -0.1, 0.0), "right -y"),
        (WORLD, (0.0, 0.0, 0.1), "up +z"),
        (WORLD, (0.0, 0.05, -0.1), "down -z"),
        (UNITY, (0.0, 0.0, 0.1), "forward +x"),
        (WORLD, (0.01, 0.0, 0.0), "still"),
    ],
)
def test_the_main_direction_of_a_movement_is_named(
    axes: tuple[str, str, str], way: tuple[float, float, float], words: str
) -> None:
    assert moved(axes, way).in_words(5.45) == words


def test_only_the_movement_of_the_last_half_second_counts() -> None:
    movement = moved(WORLD, (0.1, 0.0, 0.0))
    assert movement.in_words(5.89) == "still"
    assert movement.in_words(5.91) == "no data"


@pytest.mark.parametrize("value", [np.nan, 1e308], ids=str)
def test_hostile_positions_neither_raise_an_error_nor_hide_the_real_positions(value: float) -> None:
    movement = moved(WORLD, (0.1, 0.0, 0.0))
    movement.add(HandSample("left", np.full(3, value), np.zeros(4), 5.41))
    movement.in_words(5.42)
    assert movement.in_words(9.0) == "no data"


@pytest.mark.parametrize(
    ("changes", "says", "not_said"),
    [
        ({}, ("nothing arrives for 2 s on 127.0.0.1:10000", "--host 0.0.0.0"), ""),
        ({"address": ("0.0.0.0", 10007)}, ("10007/tcp",), "--host"),
        ({"peer": "10.0.0.7:5555"}, ("10.0.0.7:5555 is connected but sends no hand data",), "firewall"),
        ({"last_disconnect": "no frame for 2 s"}, ("the last connection ended: no frame for 2 s",), ""),
    ],
    ids=["this machine only", "on the network", "connected and silent", "after a lost connection"],
)
def test_the_advice_names_the_most_likely_cause_of_missing_data(
    changes: dict[str, Any], says: tuple[str, ...], not_said: str
) -> None:
    text = "\n".join(advice(replace(NOBODY, **changes)))
    assert all(words in text for words in says)
    assert not not_said or not_said not in text


@pytest.fixture(scope="module")
def cell() -> Config:
    return load_config("config/dual_iiwa7.yaml")


def with_one_arm(cell: Config, arm: str, stance: Stance) -> Config:
    teleop = cell.teleop.model_copy(update={"stance": stance})
    return cell.model_copy(update={"arms": {arm: cell.arms[arm]}, "teleop": teleop})  # type: ignore[index]


def test_a_run_needs_poses_and_inputs_of_each_hand_that_drives_an_arm(cell: Config) -> None:
    def of(hand: str) -> set[str]:
        return {f"q2r_{hand}_hand_pose", f"q2r_{hand}_hand_inputs"}

    assert set(needed_topics(cell)) == of("left") | of("right")
    assert set(needed_topics(with_one_arm(cell, "left", Stance.SIDE_BY_SIDE))) == of("left")
    assert set(needed_topics(with_one_arm(cell, "left", Stance.MIRROR))) == of("right")
    assert set(needed_topics(with_one_arm(cell, "right", Stance.MIRROR_REFLECTED))) == of("left")


def check_of(server: HeadsetServer, cell: Config, sent: str) -> HeadsetCheck:
    """Return the report after a headset has ``sent`` messages, such as "left pose, right inputs"."""
    with FakeHeadset(server.address) as headset:
        topics = [words.split() for words in sent.split(", ")]
        for hand, kind in topics:
            headset.send(headset.pose(hand, (0.0, 0.0, 0.0), IDENTITY) if kind == "pose" else headset.inputs(hand))
        return watch_headset(
            server,
            cell,
            None,
            lambda _: None,
            lambda: len(server.statistics.topics) == len(topics),
            CrossedHands(cell.teleop.axes),
        )


@pytest.mark.parametrize(
    ("sent", "missing", "says"),
    [
        ("left pose, left inputs, right pose, right inputs", (), ""),
        ("left pose, right inputs", ("left_hand_inputs", "right_hand_pose"), "left hand: no inputs (q2r_left_"),
        ("left pose", ("left_hand_inputs", "right_hand_pose", "right_hand_inputs"), "right hand: nothing arrives"),
        ("left pose, left inputs, right inputs", ("right_hand_pose",), "right hand: no poses"),
    ],
)
def test_the_report_names_messages_that_a_run_needs_and_that_did_not_come(
    server: HeadsetServer, cell: Config, sent: str, missing: tuple[str, ...], says: str
) -> None:
    check = check_of(server, cell, sent)
    assert check.missing == tuple(f"q2r_{name}" for name in missing)
    assert says in "\n".join(check.advice)
    assert bool(check.advice) == bool(missing)
    assert "firewall" not in "\n".join(check.advice)


class TwoHands:
    """A server with 80 samples a second of two resting hands, at ``left_y`` and -``left_y`` [m] along y."""

    url = None
    statistics = NOBODY

    def __init__(self, left_y: float) -> None:
        self._left_y = left_y

    def poll(self, now: float) -> list[HandSample]:
        places = (("left", self._left_y), ("right", -self._left_y))
        stamps = np.arange(now - 4.0, now, 0.0125)  # All samples come at once, as if the server had collected them.
        made = [(hand, y, t) for t in stamps.tolist() for hand, y in places]
        return [HandSample(hand, np.array([0.3, y, 1.0]), np.array([0, 0, 0, 1.0]), t) for hand, y, t in made]


@pytest.mark.parametrize(("left_y", "crossed"), [(0.2, False), (-0.2, True)])
def test_the_report_warns_of_swapped_controllers(left_y: float, crossed: bool, cell: Config) -> None:
    seen: list[HeadsetCheck] = []
    check = watch_headset(TwoHands(left_y), cell, None, seen.append, lambda: True, CrossedHands(cell.teleop.axes))
    assert check.crossed is crossed
    assert check.as_json()["hands_crossed"] is crossed
    assert advice_on_some((), "swapped") == ("swapped",)
