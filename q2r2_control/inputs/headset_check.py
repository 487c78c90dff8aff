"""A check of the headset's data, and advice when no data comes."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np

from q2r2_control.config.cell import Config
from q2r2_control.config.teleop import Stance, axes_matrix
from q2r2_control.inputs.listener import ONLY_THIS_MACHINE, app_settings, written
from q2r2_control.inputs.messages import MessageType
from q2r2_control.inputs.session import HAND_TOPICS, HeadsetStatistics
from q2r2_control.types import SIDES, Array, HandSample

SILENCE = 2.0  # Time without data before advice is given [s].
_PERIOD = 0.05  # Time between two polls of the server [s].
_WINDOW = 0.5  # Duration of the newest movement, which is put in words [s].
_STILL = 0.02  # A hand that has moved by less than this in ``_WINDOW`` counts as still [m].
_DIRECTIONS = (("back -x", "forward +x"), ("right -y", "left +y"), ("down -z", "up +z"))


class HandMovement:
    """Puts one hand's recent movement in words, along the world's axes that the config's ``teleop.axes`` defines."""

    def __init__(self, axes: tuple[str, str, str]) -> None:
        self._axes: Array = axes_matrix(axes)
        self._positions: deque[tuple[float, Array]] = deque(maxlen=1000)

    def add(self, sample: HandSample) -> None:
        """Take a sample. A sample that is not finite is left out."""
        if np.isfinite(sample.position).all():
            self._positions.append((sample.pose_stamp, self._axes @ sample.position))

    def in_words(self, now: float) -> str:
        """Return the main direction of movement in the last half second: "forward +x", ..., "still", or "no data"."""
        while self._positions and self._positions[0][0] < now - _WINDOW:
            self._positions.popleft()
        if not self._positions:
            return "no data"
        with np.errstate(over="ignore"):
            displacement = self._positions[-1][1] - self._positions[0][1]
        axis = int(np.abs(displacement).argmax())
        if not np.abs(displacement[axis]) >= _STILL:
            return "still"
        return _DIRECTIONS[axis][int(displacement[axis] > 0)]

    @property
    def position(self) -> Array | None:
        """The hand's newest position in the world's axes (3,) [m]; None if no sample came in the last half second."""
        return self._positions[-1][1] if self._positions else None


class CheckedServer(Protocol):
    """A server to which a headset connects, with an app or with a page at ``url``."""

    @property
    def url(self) -> str | None: ...

    @property
    def statistics(self) -> HeadsetStatistics: ...

    def poll(self, now: float) -> list[HandSample]: ...


class HandWatch(Protocol):
    """Watches the poses of both hands, and can warn about them. :class:`CrossedHands` is such a class."""

    def add(self, sample: HandSample) -> None: ...

    def warning(self, now: float) -> str | None: ...


@dataclass(frozen=True, slots=True)
class HeadsetCheck:
    """What is known about a headset's data at one time."""

    statistics: HeadsetStatistics
    directions: dict[str, str]  # The direction in which each hand moves, in words.
    positions: dict[str, Array | None]  # For each hand, its position in the world frame (3,) [m]; None without data.
    heard: bool  # Whether a sample of a hand has ever come.
    missing: tuple[str, ...]  # Topics that a run needs and of which no message has ever come.
    crossed: bool  # Whether the controllers seem to be swapped.
    advice: tuple[str, ...]  # Lines of advice; empty if nothing is wrong.

    def as_json(self) -> dict[str, Any]:
        return {
            **asdict(self.statistics),
            "topics": {
                name: {"count": topic.count, "rate_hz": topic.rate, "age_s": topic.age, "last": topic.last}
                for name, topic in self.statistics.topics.items()
            },
            "connected": self.statistics.peer is not None,
            "hands": {hand: {"direction": self.directions[hand], "position_m": self.positions[hand]} for hand in SIDES},
            "heard": self.heard,
            "missing": self.missing,
            "hands_crossed": self.crossed,
            "advice": self.advice,
        }


def watch_headset(
    server: CheckedServer,
    config: Config,
    duration: float | None,
    show: Callable[[HeadsetCheck], None],
    stopping: Callable[[], bool],
    watch: HandWatch,
) -> HeadsetCheck:
    """Watch a started server for ``duration`` [s] (None: without end), or until ``stopping()`` is True.

    Each state of the check is passed to ``show``, and the last one is returned.
    """
    hands = {hand: HandMovement(config.teleop.axes) for hand in SIDES}
    start, heard = time.monotonic(), False
    last_data = dict.fromkeys(needed_topics(config), start)
    missing = tuple(last_data)
    while True:
        now = time.monotonic()
        # The end is decided before the last poll, so that this poll takes all data up to the end.
        ends = stopping() or (duration is not None and now - start >= duration)
        for sample in server.poll(now):
            hands[sample.hand].add(sample)
            watch.add(sample)
            heard = True
        statistics = server.statistics
        for name in statistics.topics.keys() & last_data.keys():
            last_data[name] = max(last_data[name], now - statistics.topics[name].age)
        missing = tuple(name for name in missing if name not in statistics.topics)
        silent = tuple(name for name, last in last_data.items() if now - last > SILENCE)
        if ends and not silent:
            silent = missing  # At the end, missing topics count as silent, because no time is left to wait for them.
        nothing_comes = len(silent) == len(last_data)
        warning = watch.warning(now)
        check = HeadsetCheck(
            statistics=statistics,
            directions={hand: movement.in_words(now) for hand, movement in hands.items()},
            positions={hand: movement.position for hand, movement in hands.items()},
            heard=heard,
            missing=missing,
            crossed=warning is not None,
            advice=advice(statistics, server.url) if nothing_comes else advice_on_some(silent, warning),
        )
        show(check)
        if ends:
            return check
        time.sleep(_PERIOD)


def needed_topics(config: Config) -> tuple[str, ...]:
    """Return the topics that a run needs: poses and inputs (with the buttons) of each hand that drives an arm."""
    same_side = config.teleop.stance is Stance.SIDE_BY_SIDE
    hands = {hand for hand in SIDES for arm in config.arms if (hand == arm) is same_side}
    needed = (MessageType.POSE, MessageType.INPUTS)
    return tuple(name for name, topic in HAND_TOPICS.items() if topic.hand in hands and topic.kind in needed)


def advice_on_some(silent: tuple[str, ...], warning: str | None = None) -> tuple[str, ...]:
    """Return advice if some topics come and others are ``silent``: one line for each hand with silent topics.

    If there is a ``warning`` about the poses of both hands, it is the first line.
    """
    lines = [] if warning is None else [warning]
    for hand in SIDES:
        kinds = {HAND_TOPICS[name].kind: name for name in silent if HAND_TOPICS[name].hand == hand}
        if len(kinds) == 2:
            lines.append(f"{hand} hand: nothing arrives: switch its controller on and keep it in the headset's view")
        elif name := kinds.get(MessageType.INPUTS):
            lines.append(f"{hand} hand: no inputs ({name}): without its buttons a run cannot engage an arm")
        elif name := kinds.get(MessageType.POSE):
            lines.append(f"{hand} hand: no poses ({name}): a run has nothing to follow")
    return tuple(lines)


def advice(statistics: HeadsetStatistics, url: str | None = None) -> tuple[str, ...]:
    """Return the things to check if no data comes, the most likely cause first."""
    host, port = statistics.address
    lines = [f"nothing arrives for {SILENCE:g} s on {written(host, port)}"]
    if statistics.peer is not None:
        return (
            *lines,
            f"{statistics.peer} is connected but sends no hand data: put the headset on, keep both controllers in view",
            "the page sends hands once VR or AR is entered"
            if url is not None
            else "look at the protocol setting in the app: ROS2 and ROS1 are both understood, but has it been started?",
        )
    if statistics.last_disconnect is not None:
        lines.append(f"the last connection ended: {statistics.last_disconnect}")
    if host in ONLY_THIS_MACHINE:
        lines.append(f"{host} can be reached from this machine only: start again with --host 0.0.0.0")
    return (
        *lines,
        f"open {url} in the headset's browser"
        if url is not None
        else f"what the app has to have: {app_settings(host, port)}",
        "headset and this machine have to be in the same network, one that lets its members talk to each other",
        f"a firewall on this machine must let TCP port {port} in (ufw allow {port}/tcp)",
    )
