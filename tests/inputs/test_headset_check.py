"""What headset-check says: which way a hand moves, and what to look at when nothing comes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from q2r2_control.inputs.headset_check import HandMovement, advice
from q2r2_control.inputs.statistics import HeadsetStatistics
from q2r2_control.types import HandSample

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
        (WORLD, (-0.1, 0.02, 0.05), "back -x"),
        (WORLD, (0.0, 0.1, 0.0), "left +y"),
        (WORLD, (0.0, -0.1, 0.0), "right -y"),
        (WORLD, (0.0, 0.0, 0.1), "up +z"),
        (WORLD, (0.0, 0.05, -0.1), "down -z"),
        (UNITY, (0.0, 0.0, 0.1), "forward +x"),
        (UNITY, (0.1, 0.0, 0.0), "right -y"),
        (UNITY, (0.0, 0.1, 0.0), "up +z"),
        (WORLD, (0.01, 0.0, 0.0), "still"),
    ],
)
def test_the_dominant_direction_is_named_in_the_worlds_axes(
    axes: tuple[str, str, str], way: tuple[float, float, float], words: str
) -> None:
    assert moved(axes, way).in_words(5.45) == words


def test_only_the_last_half_second_counts() -> None:
    movement = moved(WORLD, (0.1, 0.0, 0.0))
    assert movement.in_words(5.89) == "still"
    assert movement.in_words(5.91) == "no data"


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e308, 1e308], ids=str)
def test_hostile_positions_neither_raise_nor_hide_the_real_ones(value: float) -> None:
    movement = moved(WORLD, (0.1, 0.0, 0.0))
    movement.add(HandSample("left", np.full(3, value), np.zeros(4), 5.41))
    movement.in_words(5.42)
    assert movement.in_words(9.0) == "no data"


def test_advice_names_the_bound_address_and_that_only_this_machine_can_reach_it() -> None:
    text = "\n".join(advice(NOBODY))
    assert "nothing arrives for 2 s on 127.0.0.1:10000" in text
    assert "--host 0.0.0.0" in text


def test_advice_for_a_server_that_the_network_can_reach_is_about_the_network() -> None:
    text = "\n".join(advice(replace(NOBODY, address=("0.0.0.0", 10007))))
    assert "--host" not in text
    assert "10007/tcp" in text
    assert "address 0.0.0.0" not in text


def test_advice_for_a_headset_that_is_connected_but_silent_is_about_the_headset() -> None:
    text = "\n".join(advice(replace(NOBODY, peer="10.0.0.7:5555")))
    assert "10.0.0.7:5555 is connected but sends no hand data" in text
    assert "firewall" not in text


def test_advice_after_a_lost_connection_says_why_it_was_lost() -> None:
    assert "no frame for 2 s" in "\n".join(advice(replace(NOBODY, last_disconnect="no frame for 2 s")))
