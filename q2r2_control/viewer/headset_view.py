"""The part of a headset's display that belongs to the run.

It sends ticks to the process that serves the headset's page, and does what the buttons of the page request.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from q2r2_control.inputs.base import Input
from q2r2_control.inputs.webxr.exchange import Display
from q2r2_control.inputs.webxr.page_messages import HeadsetRequest
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.base import is_mujoco
from q2r2_control.summary.tick import Tick
from q2r2_control.types import ActiveLimit
from q2r2_control.viewer.arm_words import Told, told_after
from q2r2_control.viewer.episode_words import EpisodeWords
from q2r2_control.viewer.headset_display import RunDisplay, ShownTick
from q2r2_control.viewer.loose_parts import places_of_parts
from q2r2_control.viewer.shown_robot import ShownRobot

_PERIOD = 1.0 / 30.0  # Time between messages [s].


class DisplayInput(Input, Protocol):
    """An input whose device shows the run, as a headset does."""

    def show_on(self, display: Display, requests: Mapping[HeadsetRequest, Callable[[], None]]) -> None:
        """Show a run on the device. This is called before ``start``.

        Args:
            display: Makes the data that are shown.
            requests: The function to call for each request of a button. Any thread may call it.
        """

    def show(self, content: Any) -> bool:
        """Show the newest state. Return False if the previous state is not sent yet. The method never waits."""

    def show_picture(self, jpeg: bytes) -> bool:
        """Show the newest picture of a camera. Return False if the previous picture is not sent yet.

        The method never waits. Any thread may call it.
        """


class HeadsetView:
    """A listener of one run. It collects the ticks' data, and sends them to the input's process 30 times a second."""

    def __init__(self, source: DisplayInput, pipeline: Pipeline, recorded: bool) -> None:
        self._source = source
        self._due = 0.0  # Time of the next message, by the monotonic clock [s].
        self._binding: dict[ActiveLimit, None] = {}
        self._told: dict[str, Told] = {}
        self._episodes = EpisodeWords(pipeline.config.recording.subtasks) if recorded else None
        self._hand_of = pipeline.teleop.hand_of
        self._plant = pipeline.plant if is_mujoco(pipeline.plant) else None
        robot, parts = pipeline.robot, places_of_parts(pipeline.plant, pipeline.config)
        display = RunDisplay(ShownRobot.of(robot, pipeline.config), robot.model, robot.collision_model, parts)
        requests = {
            HeadsetRequest.STOP: pipeline.stop,
            HeadsetRequest.HOME: pipeline.go_home,
            HeadsetRequest.PAUSE: pipeline.pause,
        }
        source.show_on(display, requests)
        pipeline.listeners.append(self)

    def __call__(self, tick: Tick) -> None:
        if tick.events:
            self._told = told_after(self._told, tick.events)
            if self._episodes is not None:
                self._episodes.follow(tick.events)
        if tick.reference.report.binding:
            self._binding.update(dict.fromkeys(tick.reference.report.binding))
        now = time.monotonic()
        if now < self._due:
            return
        hands = {arm: self._hand_of(arm) for arm in tick.tools}
        moved = None if self._plant is None else self._plant.observed_qpos
        recording = "" if self._episodes is None else self._episodes.text
        if self._source.show(ShownTick(tick, tuple(self._binding), self._told, hands, moved, recording)):
            self._due = now + _PERIOD
            self._binding = {}
