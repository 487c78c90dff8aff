"""The data that a run and the process that serves its page send to each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import pinocchio as pin

from q2r2_control.device_words import DeviceWords
from q2r2_control.events import Event
from q2r2_control.summary.tick import Tick
from q2r2_control.types import ActiveLimit, Array
from q2r2_control.viewer.shown_robot import ShownRobot


@dataclass(frozen=True)
class PageSetup(ShownRobot):
    """The first message to the process: the cell, the contents of the page, and the address at which to listen."""

    host: str
    port: int  # The port to listen on; 0 for any free port.
    addresses: tuple[str, ...]  # Addresses at which other computers reach the server.
    certificate: str | None  # A PEM file with a certificate and its key; None for plain HTTP.
    title: str
    tools: Mapping[str, int]  # For each arm, the index of its tool frame in ``model``.
    home: Array  # Joint positions at home (nv,) [rad].
    lower: Array  # Lower position limits (nv,) [rad].
    upper: Array  # Upper position limits (nv,) [rad].
    model: pin.Model
    collision_model: pin.GeometryModel  # The bodies, and the pairs that are kept apart.
    parts: Mapping[str, int]  # For each loose part, the index in ``Frame.moved`` at which its pose begins.
    requests: tuple[PageRequest, ...]  # Requests that have a button.
    changes: tuple[PageSetting, ...]  # Settings that have a slider.
    device: DeviceWords  # Words for the device that drives the arms.
    driven: bool  # Whether the page is the run's input, so that it moves the arms.
    replayed: bool  # Whether the page shows a recorded run.


@dataclass(frozen=True, slots=True)
class Frame:
    """What the run sends to the page: the newest tick, and the events of all ticks since the last frame."""

    tick: Tick
    events: tuple[Event, ...]
    binding: tuple[ActiveLimit, ...]  # Limits that held a step back since the last frame.
    ticks: int  # Number of ticks since the last frame.
    slowest: float  # Computing time of the slowest of these ticks [s].
    moved: Array | None  # MuJoCo's positions (qpos) of everything that moves.
    end: float = 0.0  # In a replay, the time up to which frames exist [s].
    ages: Mapping[str, float] = field(default_factory=dict)  # For each arm, the age of its hand's newest pose [s].
    why: Mapping[str, str] = field(default_factory=dict)  # Reasons of other programs for the states of arms.
    driver: str = ""  # The person or page that drives, in words; empty if not known.
    notice: str = ""  # The result of a request of a button, in words; empty if there is none.
    pictures: Mapping[str, bytes] = field(default_factory=dict)  # The newest pictures by camera, JPEG or PNG.


class Ready(NamedTuple):
    """The server's first answer, which says that it listens."""

    urls: tuple[str, ...]  # One URL for each address of the server.


class PageWatched(NamedTuple):
    """A browser connected or disconnected."""

    pages: int  # Number of pages that are open now.


class PageHand(NamedTuple):
    """A hand that a page moves. The numbers come from a browser, and are not checked yet."""

    hand: str
    position: tuple[float, ...]  # In the world frame [m].
    quaternion: tuple[float, ...]  # In the order x y z w.
    drag: bool  # Whether the page drags this hand's tool.
    gripper: bool  # Whether the button of the gripper is pressed.


class PageLost(NamedTuple):
    """The connection to the page that drove has ended."""


class PageSetting(StrEnum):
    """The settings that a page's sliders change."""

    SPEED = "speed"  # Share of the tool speeds that the cell allows.
    STIFFNESS = "stiffness"  # Share of the cell's stiffness in torque mode.
    DAMPING = "damping"  # Damping ratio in torque mode.
    SCALE = "scale"  # The setting teleop.position_scale.


class PageChange(NamedTuple):
    """A slider was moved. The number comes from a browser."""

    setting: PageSetting
    value: float


class PageSeek(NamedTuple):
    """The time line was moved. The number comes from a browser."""

    time: float  # [s]


class PagePlay(NamedTuple):
    """The replay is to play, or to pause if it plays now."""


class PageRequest(StrEnum):
    """What the buttons of the page request."""

    STOP = "stop"
    RESET = "reset"  # Takes back a stop that does not end the run.
    ENGAGE = "engage"
    PAUSE = "pause"
    HOME = "home"
    RECORD = "record"
    MARK = "mark"
    SUBTASK = "next_subtask"
