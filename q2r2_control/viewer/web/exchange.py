"""The data that a run and the server of its page exchange."""

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
    """The first message to the server: the cell, and where to listen."""

    host: str
    port: int  # 0: any free one
    addresses: tuple[str, ...]  # by which others reach it
    certificate: str | None  # a PEM file with its key; None: http
    title: str
    tools: Mapping[str, int]  # of each arm, the frame of its tool in ``model``
    home: Array  # (nv,) [rad]
    lower: Array  # (nv,) position limits [rad]
    upper: Array
    model: pin.Model
    collision_model: pin.GeometryModel  # whose pairs are monitored
    parts: Mapping[str, int]  # loose objects by name -> where their pose begins in ``Frame.moved``
    requests: tuple[PageRequest, ...]  # whose buttons are shown
    changes: tuple[PageSetting, ...]  # whose sliders are shown
    device: DeviceWords  # of what drives the arms
    driven: bool  # whether the page is the run's input
    replayed: bool  # whether the run is a recorded one


@dataclass(frozen=True, slots=True)
class Frame:
    """The newest tick, and what has come together since the last frame."""

    tick: Tick
    events: tuple[Event, ...]
    binding: tuple[ActiveLimit, ...]  # limits that held a step back
    ticks: int
    slowest: float  # tick among them [s]
    moved: Array | None  # MuJoCo's positions of all that moves
    end: float = 0.0  # of what can be shown of a replay, by its time [s]
    ages: Mapping[str, float] = field(default_factory=dict)  # of the newest pose of each arm's hand [s]
    why: Mapping[str, str] = field(default_factory=dict)  # of each arm, where another program knows it
    driver: str = ""  # who drives, in words; empty where that is not known
    notice: str = ""  # what became of a request
    pictures: Mapping[str, bytes] = field(default_factory=dict)  # newest ones by camera, JPEG or PNG


class Ready(NamedTuple):
    """The server's first answer: it listens."""

    urls: tuple[str, ...]  # one for each of its addresses


class PageWatched(NamedTuple):
    """Browsers came or went."""

    pages: int  # that are open now


class PageHand(NamedTuple):
    """A hand that a page moves; the numbers are a browser's, and nothing has checked them."""

    hand: str
    position: tuple[float, ...]  # world [m]
    quaternion: tuple[float, ...]  # x y z w
    drag: bool
    gripper: bool


class PageLost(NamedTuple):
    """The page that drove is gone."""


class PageSetting(StrEnum):
    """The settings that a page's sliders change."""

    SPEED = "speed"  # part of the cell's speeds of a tool
    STIFFNESS = "stiffness"  # part of the cell's, of torque mode
    DAMPING = "damping"  # ratio, of torque mode
    SCALE = "scale"  # teleop.position_scale


class PageChange(NamedTuple):
    """A slider was moved; the number is a browser's."""

    setting: PageSetting
    value: float


class PageSeek(NamedTuple):
    """The time line was moved; the number is a browser's."""

    time: float  # [s]


class PagePlay(NamedTuple):
    """A replay is to play, or to stand still where it plays."""


class PageRequest(StrEnum):
    """The requests of the page's buttons."""

    STOP = "stop"
    RESET = "reset"  # takes back a stop that ends no run
    ENGAGE = "engage"
    PAUSE = "pause"
    HOME = "home"
    RECORD = "record"
    MARK = "mark"
