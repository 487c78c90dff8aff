"""The stations that docs/architecture.md lists are the calls of one tick, in the order of the page."""

from __future__ import annotations

import re
import sys
from functools import cache
from pathlib import Path
from types import FrameType

from q2r2_control.inputs.scripted import ScriptedInput
from tests.support.processes import pipeline_of

PAGE = Path(__file__).parents[2] / "docs/architecture.md"
FOLLOWS = 1.5  # The hands move in circles at this time [s].


def listed() -> list[tuple[str, ...]]:
    """Return the functions of each station, such as ``Supervisor.tick``. The first column has the station's number."""
    rows = re.findall(r"^\| (\d+) \|(?:[^|]*\|){3}([^|]*)\|$", PAGE.read_text(), re.MULTILINE)
    assert [int(number) for number, _ in rows] == list(range(1, 15))
    return [tuple(re.findall(r"`([A-Z]\w+\.\w+)`", functions)) for _, functions in rows]


@cache
def calls_of_a_tick_with_samples() -> dict[str, int]:
    """Return the qualified names of all functions that are called in a tick that receives samples.

    The value of each name is the number of functions whose first calls came earlier.
    """
    pipeline = pipeline_of({"loop_rate_hz": 500.0, "cameras": {}}, ScriptedInput("circle"), "kinematic", "position")
    pipeline.begin()
    pipeline.tick_until(pipeline.tick().now + FOLLOWS)
    assert all(pipeline.teleop.engaged.values())
    while True:
        places: dict[str, int] = {}

        def record(frame: FrameType, event: str, argument: object, places: dict[str, int] = places) -> None:
            if event == "call":
                places.setdefault(frame.f_code.co_qualname, len(places))

        sys.setprofile(record)
        try:
            tick = pipeline.tick()
        finally:
            sys.setprofile(None)
        if tick.samples:
            pipeline.end()
            return places


def test_the_stations_on_the_page_are_called_in_its_order() -> None:
    places = calls_of_a_tick_with_samples()
    first_calls = [(places[station[0]], station[0]) for station in listed() if station]
    assert len(first_calls) == 13, "only the station that certifies is a kernel, which Python does not call"
    assert first_calls == sorted(first_calls)


def test_every_function_that_a_station_names_is_called_in_a_tick() -> None:
    named = {function for station in listed() for function in station}
    assert len(named) > 18
    assert named <= calls_of_a_tick_with_samples().keys()
