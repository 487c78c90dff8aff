"""The run's side of its page: hands ticks to the process that serves it, and does what its buttons ask for."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from functools import partial
from importlib.util import find_spec
from threading import Event as Flag
from typing import Any

from pydantic import ValidationError

from q2r2_control.config.bindings import Action
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.errors import ConfigError
from q2r2_control.events import Event
from q2r2_control.inputs.web import WebInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.process.helper_process import HelperProcess, reason_of
from q2r2_control.summary.tick import Tick
from q2r2_control.types import ActiveLimit
from q2r2_control.viewer.web.exchange import (
    Frame,
    PageChange,
    PageHand,
    PageLost,
    PageRequest,
    PageSetting,
    PageSetup,
    Ready,
)

_PERIOD = 1.0 / 30.0  # between frames [s]
_READY = 120.0  # for the process to be ready, before the run, on a busy computer [s]
_PATIENCE = 2.0  # for it to end [s]

_logger = logging.getLogger(__name__)


class PageView(AbstractContextManager["PageView"]):
    """A listener of one run, as a context around it. Nothing in a browser can keep the loop waiting.

    A tick stores references, 30 times a second a thread gets them; where it is not done with the last ones, newer ones
    come later instead. A page that fails is one line, and the run goes on.
    """

    def __init__(self, host: str, port: int) -> None:
        """Start the process, which takes a second. Raises :class:`ConfigError` where viser is not installed."""
        if find_spec("viser") is None:
            raise ConfigError("--web needs viser: pip install 'q2r2_control[web]'")
        self._host, self._port = host, port
        self._ready = Flag()
        self.url: str | None = None  # None: not begun
        self._due = 0.0  # of the next frame, by the clock on the wall [s]
        self._events: list[Event] = []
        self._binding: dict[ActiveLimit, None] = {}
        self._ticks, self._slowest = 0, 0.0
        self._heard: dict[str, float] = {}  # hand -> when its newest pose came, by the loop's clock [s]
        self._plant: MujocoPlant | None = None  # whose loose objects are shown
        self._input: WebInput | None = None  # that the page drives
        self._requests: dict[PageRequest, Callable[[], None]] = {}
        self._on_request: Callable[[Any], None] | None = None  # instead of the run
        self._changes: dict[PageSetting, Callable[[float], None]] = {}
        self._hand_of: Callable[[str], str]  # that drives an arm
        try:
            # Room for one frame: a newer one is better than a queue.
            self._process = HelperProcess("serves the page", "q2r2_control.viewer.web.server", self._on_answer, room=1)
        except OSError as error:
            raise ConfigError(f"--web: {reason_of(error)}") from error

    def begin(self, pipeline: Pipeline, title: str, recorded: bool) -> str:
        """Serve the page of a run that is about to begin; returns its URL. Raises :class:`ConfigError`."""
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
        """Serve a page; returns its URL. ``on_request`` gets what its buttons ask for, instead of the run."""
        self._on_request = on_request
        robot, plant = pipeline.robot, pipeline.plant
        source: object = pipeline.input
        while (operator := getattr(source, "operator", None)) is not None:  # of a policy: its hands
            source = operator
        self._input = source if isinstance(source, WebInput) else None
        parts = {}
        if isinstance(plant, MujocoPlant):
            self._plant = plant
            names = pipeline.config.mujoco.objects
            parts = {name: int(plant.model.joint(f"{name}_free").qposadr[0]) for name in names}
        self._requests = {
            PageRequest.STOP: pipeline.stop,
            PageRequest.ENGAGE: pipeline.engage,
            PageRequest.PAUSE: pipeline.pause,
            PageRequest.HOME: pipeline.go_home,
            PageRequest.RECORD: partial(pipeline.mark, Action.RECORD_TOGGLE),
            PageRequest.MARK: partial(pipeline.mark, Action.RECORD_MARK),
        }
        self._changes, self._hand_of = _changes_of(pipeline), lambda arm: pipeline.teleop.hand_of(arm)
        setup = PageSetup(
            host=self._host,
            port=self._port,
            title=title,
            config=pipeline.config,
            urdf=robot.urdf,
            joint_names=robot.joint_names,
            joints={arm: its.joints for arm, its in robot.arms.items()},
            fingers={arm: its.finger_joints for arm, its in robot.arms.items()},
            tools={arm: its.frame_id for arm, its in robot.arms.items()},
            home=robot.home,
            lower=robot.position_lower,
            upper=robot.position_upper,
            model=robot.model,
            collision_model=robot.collision_model,
            parts=parts,
            recorded=recorded,
            driven=self._input is not None,
            replayed=replayed,
            yields=pipeline.drive.yields,
        )
        self._process.send(setup)
        waited = 0.0
        while self._process.alive and waited < _READY and not self._ready.wait(0.1):
            waited += 0.1
        if self.url is None:
            raise ConfigError(self._process.fault or f"--web: the page was not ready within {_READY:g} s")
        return self.url

    @property
    def alive(self) -> bool:
        return self._process.alive

    def send(self, frame: Frame) -> bool:
        """Show a frame, unless the page is not done with the last one."""
        return self._process.send(frame, 1)

    def __call__(self, tick: Tick) -> None:
        """Store one tick, and send it where a frame is due."""
        self._ticks += 1
        self._slowest = max(self._slowest, tick.compute_time)
        for sample in tick.samples:
            self._heard[sample.hand] = sample.pose_stamp
        if tick.events:
            self._events += tick.events
        if tick.reference.report.binding:
            self._binding.update(dict.fromkeys(tick.reference.report.binding))
        now = time.monotonic()
        if now < self._due or self.url is None:
            return
        if not self._process.alive:
            self.url = None
            _logger.warning("the page is gone, the run goes on: %s", self._process.fault)
            return
        moved = None if self._plant is None else self._plant.observed_qpos
        stamps = {arm: self._heard.get(self._hand_of(arm)) for arm in tick.tools}
        ages = {arm: tick.now - stamp for arm, stamp in stamps.items() if stamp is not None}
        frame = Frame(tick, tuple(self._events), tuple(self._binding), self._ticks, self._slowest, moved, ages=ages)
        if self.send(frame):
            self._due = now + _PERIOD
            self._events, self._binding, self._ticks, self._slowest = [], {}, 0, 0.0

    def _on_answer(self, answer: Any) -> None:
        """In a thread of its own."""
        if isinstance(answer, Ready):
            self.url = answer.url
            self._ready.set()
        elif self._on_request is not None:
            self._on_request(answer)
        elif isinstance(answer, PageRequest):
            self._requests[answer]()
        elif isinstance(answer, PageChange):
            with suppress(ConfigError):  # a number that no slider has
                self._changes[answer.setting](answer.value)
        elif self._input is not None and isinstance(answer, PageHand):
            controls = {"drag": float(answer.drag), "gripper": float(answer.gripper)}
            self._input.receive(answer.hand, answer.position, answer.quaternion, controls)
        elif self._input is not None and isinstance(answer, PageLost):
            self._input.lose()

    def __exit__(self, *_: object) -> None:
        self._process.finish(_PATIENCE)


def _changes_of(pipeline: Pipeline) -> dict[PageSetting, Callable[[float], None]]:
    """The effect of each slider: speeds stay below the cell's, and a number that is not allowed changes nothing."""
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
        with suppress(ValidationError):
            pipeline.change_teleop(TeleopSettings.model_validate(teleop.model_dump() | {"position_scale": factor}))

    return {
        PageSetting.SPEED: limit_speed,
        PageSetting.STIFFNESS: stiffen,
        PageSetting.DAMPING: damp,
        PageSetting.SCALE: scale,
    }
