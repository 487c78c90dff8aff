"""The part of a page that belongs to the run.

It sends ticks to the process that serves the page, and does what the buttons of the page request.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from q2r2_control.config.bindings import Action
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.errors import ConfigError
from q2r2_control.events import Event
from q2r2_control.inputs.web import WebInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.base import is_mujoco
from q2r2_control.summary.tick import Tick
from q2r2_control.types import ActiveLimit
from q2r2_control.viewer.loose_parts import places_of_parts
from q2r2_control.viewer.web.exchange import (
    Frame,
    PageChange,
    PageHand,
    PageLost,
    PageRequest,
    PageSetting,
)
from q2r2_control.viewer.web.page import Page

if TYPE_CHECKING:
    from q2r2_control.plants.mujoco import MujocoPlant

_PERIOD = 1.0 / 30.0  # Time between frames [s].

_logger = logging.getLogger(__name__)


class PageView(Page):
    """Shows one run on a page: a listener of the run, and a context around it. No browser can keep the loop waiting.

    At each tick, references to the newest data are stored. 30 times a second, a thread of the page sends them to the
    page's process. If this thread is still busy with earlier data, it sends newer data later. If the page fails, one
    line is logged and the run goes on.
    """

    def __init__(self, host: str, port: int, certificate: Path | None = None) -> None:
        """Start the process, which takes a second.

        Args:
            host: The address to bind; 0.0.0.0 stands for all addresses of this computer.
            port: The port; 0 for any free port.
            certificate: A PEM file with a certificate and its key, for HTTPS; None for the certificate of the
                headset's page.

        Raises:
            ConfigError: If viser is not installed, or if the address cannot be bound.
        """
        self._due = 0.0  # Time of the next frame, by the monotonic clock [s].
        self._events: list[Event] = []
        self._binding: dict[ActiveLimit, None] = {}
        self._ticks, self._slowest = 0, 0.0
        self._heard: dict[str, float] = {}  # For each hand, the time of its newest pose on the loop's clock [s].
        self._plant: MujocoPlant | None = None  # The simulator whose loose objects are shown.
        self._input: WebInput | None = None  # The input that the page drives.
        self._requests: dict[PageRequest, Callable[[], None]] = {}
        self._changes: dict[PageSetting, Callable[[float], None]] = {}
        self._hand_of: Callable[[str], str]  # Returns the hand that drives an arm.
        self._source: object = None  # The input from which the hands come.
        self._nobody = ""  # Why no person drives, in words; empty if a person may drive.
        super().__init__(host, port, self._do, certificate)

    def begin(self, pipeline: Pipeline, title: str, recorded: bool) -> str:
        """Serve the page of a run before it begins.

        Args:
            pipeline: The pipeline of the run, which gets this object as a listener.
            title: The title of the page.
            recorded: Whether the run is recorded, so that the page can mark episodes.

        Returns:
            The URL of the page. ``lines`` tells people where to find it.

        Raises:
            ConfigError: If the page cannot be served there.
        """
        url = self.serve(pipeline, title, recorded=recorded)
        pipeline.listeners.append(self)
        return url

    def serve(
        self,
        pipeline: Pipeline,
        title: str,
        *,
        recorded: bool = False,
        replayed: bool = False,
        on_request: Callable[[Any], None] | None = None,
    ) -> str:
        """Serve a page, and return its URL.

        The requests of its buttons go to ``on_request`` if it is given, otherwise to the run.
        """
        if on_request is not None:
            self._on_request = on_request
        config, plant = pipeline.config, pipeline.plant
        source: object = pipeline.input
        # The input of a policy can contain the input of an operator.
        while (operator := getattr(source, "operator", None)) is not None:
            source = operator
        self._input = source if isinstance(source, WebInput) else None
        self._source, self._nobody = source, pipeline.input.controls.words.nobody
        self._plant = plant if is_mujoco(plant) else None
        self._requests = {
            PageRequest.STOP: pipeline.stop,
            PageRequest.ENGAGE: pipeline.engage,
            PageRequest.PAUSE: pipeline.pause,
            PageRequest.HOME: pipeline.go_home,
            PageRequest.RECORD: partial(pipeline.mark, Action.RECORD_TOGGLE),
            PageRequest.MARK: partial(pipeline.mark, Action.RECORD_MARK),
            PageRequest.SUBTASK: partial(pipeline.mark, Action.NEXT_SUBTASK),
        }
        self._changes, self._hand_of = _changes_of(pipeline), lambda arm: pipeline.teleop.hand_of(arm)
        by_press = any(one.action is Action.PAUSE_TOGGLE for one in config.teleop.bindings.bound())
        hidden = {
            *([] if by_press else [PageRequest.ENGAGE]),
            *([] if recorded else [PageRequest.RECORD, PageRequest.MARK, PageRequest.SUBTASK]),
            *([] if pipeline.drive.yields else [PageSetting.STIFFNESS, PageSetting.DAMPING]),
            *([] if self._input is None else [PageSetting.SCALE]),
        }
        return self.open(
            pipeline.robot,
            config,
            title,
            tuple(one for one in self._requests if one not in hidden),
            tuple(one for one in self._changes if one not in hidden),
            parts=places_of_parts(plant, config),
            device=pipeline.input.controls.words,
            driven=self._input is not None,
            replayed=replayed,
        )

    def __call__(self, tick: Tick) -> None:
        """Store one tick, and send it if a frame is due."""
        self._ticks += 1
        self._slowest = max(self._slowest, tick.compute_time)
        for sample in tick.samples:
            self._heard[sample.hand] = sample.pose_stamp
        if tick.events:
            self._events += tick.events
        if tick.reference.report.binding:
            self._binding.update(dict.fromkeys(tick.reference.report.binding))
        now = time.monotonic()
        if now < self._due or not self.urls:
            return
        if not self.alive:
            self.urls = ()
            _logger.warning("the page is gone, the run goes on: %s", self.fault)
            return
        moved = None if self._plant is None else self._plant.observed_qpos
        stamps = {arm: self._heard.get(self._hand_of(arm)) for arm in tick.tools}
        ages = {arm: tick.now - stamp for arm, stamp in stamps.items() if stamp is not None}
        frame = Frame(
            tick,
            tuple(self._events),
            tuple(self._binding),
            self._ticks,
            self._slowest,
            moved,
            ages=ages,
            driver=self._driver,
        )
        if self.send(frame):
            self._due = now + _PERIOD
            self._events, self._binding, self._ticks, self._slowest = [], {}, 0, 0.0

    @property
    def _driver(self) -> str:
        """The device that drives, in words; empty if the input does not know it."""
        # The attribute is read once, because another thread may change it.
        driver = getattr(self._source, "driver", "")
        if self._nobody or driver == "":
            return self._nobody
        return "nobody drives" if driver is None else f"the headset at {driver} drives"

    def _do(self, answer: Any) -> None:
        """Do what an answer of the page requests. The thread that receives the answers calls this."""
        if isinstance(answer, PageRequest):
            self._requests[answer]()
        elif isinstance(answer, PageChange):
            with suppress(ConfigError):  # A browser may send a number that no slider allows.
                self._changes[answer.setting](answer.value)
        elif self._input is not None and isinstance(answer, PageHand):
            controls = {"drag": float(answer.drag), "gripper": float(answer.gripper)}
            self._input.receive(answer.hand, answer.position, answer.quaternion, controls)
        elif self._input is not None and isinstance(answer, PageLost):
            self._input.lose()


def _changes_of(pipeline: Pipeline) -> dict[PageSetting, Callable[[float], None]]:
    """Return a function for each slider, which gets the slider's value.

    A slider cannot set a speed above the cell's own speed. A value that is not allowed changes nothing.
    """
    control, teleop, impedance = pipeline.config.control, pipeline.config.teleop, pipeline.config.impedance

    def limit_speed(part: float) -> None:
        part = min(part, 1.0)
        names = ("max_linear_speed", "max_angular_speed")
        pipeline.change_control({name: part * getattr(control, name) for name in names})

    def stiffen(part: float) -> None:
        names = ("translational_stiffness", "rotational_stiffness")
        pipeline.change_control({name: part * getattr(impedance, name) for name in names})

    def damp(ratio: float) -> None:
        pipeline.change_control({"damping_ratio": ratio})

    def scale(factor: float) -> None:
        pipeline.change_teleop(TeleopSettings.model_validate(teleop.model_dump() | {"position_scale": factor}))

    return {
        PageSetting.SPEED: limit_speed,
        PageSetting.STIFFNESS: stiffen,
        PageSetting.DAMPING: damp,
        PageSetting.SCALE: scale,
    }
