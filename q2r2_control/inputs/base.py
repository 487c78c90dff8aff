"""The interface of every source of hand samples: a script, the headset, a recording."""

from __future__ import annotations

from types import NoneType
from typing import Protocol, runtime_checkable

import numpy as np

from q2r2_control.config.cell import Config
from q2r2_control.errors import InputError, check_kind
from q2r2_control.plugins import INPUTS, load_class
from q2r2_control.robot.robot import Robot
from q2r2_control.types import (
    ActionChunk,
    DeviceControls,
    HandFault,
    HandInputs,
    HandSample,
    HapticFeedback,
    Observation,
)

_SAMPLE: tuple[tuple[str, type | tuple[type, ...], str], ...] = (
    ("pose_stamp", (float, int, np.number), "a time [s]"),
    ("inputs", HandInputs, "HandInputs"),
    ("inputs_stamp", (float, int, np.number), "a time [s]"),
    ("fault", (HandFault, NoneType), "a HandFault, or None"),
)


@runtime_checkable
class Input(Protocol):
    """A source of hand samples, polled once per control tick by the loop's own thread.

    Order of use: ``start``, then ``poll`` and ``send_haptic`` in any order, then ``close``. An input that is found by
    its name has a class method ``from_config(config)`` as well. Its class may have further attributes: ``options``,
    names of what ``from_config`` takes by keyword, which are options of ``q2r2 run`` and ``say``, a function that
    prints a line; ``cell``, a function that returns a cell with what this input knows better, as its own axes;
    ``executable``, the ROS executable that stands for it instead of ``hand_input``; and ``simulated``, True if its
    samples follow from the times of its polls, so that a run may be in simulated time.
    """

    controls: DeviceControls  # the buttons and axes that its samples have

    @property
    def connected(self) -> bool:
        """Whether samples can arrive now. The loop reports every change from True to False to the teleop layer."""

    def start(self) -> None:
        """Begin to receive; returns at once. Raises :class:`Q2R2Error` when the source cannot be opened."""

    def poll(self, now: float) -> list[HandSample]:
        """Samples that came in since the last poll, oldest first; empty when there are none.

        ``now`` [s] is on the clock of the samples' stamps. Never waits, and never raises because of what was received.
        The returned samples stay as they are: others keep it for some ticks.
        """

    def send_haptic(self, feedback: HapticFeedback) -> None:
        """Vibrate a hand controller if the source has any; otherwise nothing happens. Never waits."""

    def close(self) -> None:
        """Release every resource; may be called twice."""


@runtime_checkable
class PolicySource(Input, Protocol):
    """An input that brings actions of a policy too. In each run, ``prepare`` comes before ``start``."""

    def prepare(self, robot: Robot, realtime: bool) -> None:
        """A run of ``robot`` begins; in simulated time, the policy has to be waited for."""

    def chunks(self) -> list[ActionChunk]:
        """Chunks that came in since the last call, oldest first. Never waits and never raises."""

    def observe(self, observation: Observation) -> None:
        """The state of a tick, for the policy; its numbers stay as they are. In real time this never waits."""


def check_samples(samples: list[HandSample]) -> list[HandSample]:
    """The ``samples`` of a poll. Raises :class:`InputError` for what is none; their numbers may be any."""
    check_kind("poll() of the input", samples, list, "a list of HandSample", InputError)
    for sample in samples:
        check_kind("a sample of the input", sample, HandSample, "a HandSample", InputError)
        for name, kind, allowed in _SAMPLE:
            check_kind(f"{name} of a sample of the input", getattr(sample, name), kind, allowed, InputError)
    return samples


def options_of(source: str) -> tuple[str, ...]:
    """The options that the input called ``source`` takes. Raises :class:`ConfigError` for an unknown name."""
    return tuple(getattr(load_class(INPUTS, source), "options", ()))


def is_simulated(source: str) -> bool:
    """True if the input called ``source`` can be polled in simulated time. Raises :class:`ConfigError` for no input."""
    return bool(getattr(load_class(INPUTS, source), "simulated", False))


def adapted(source: str, config: Config) -> Config:
    """The cell with the settings that the input called ``source`` knows better."""
    adapt = getattr(load_class(INPUTS, source), "cell", None)
    return config if adapt is None else adapt(config)


def make_input(source: Input | str, config: Config, **options: object) -> Input:
    """The input called ``source``, with those of the ``options`` that it takes, or ``source`` itself.

    Raises :class:`ConfigError` for an unknown name.
    """
    if not isinstance(source, str):
        check_kind("input", source, Input, "the name of an input, or an object with all methods of Input")
        return source
    taken = {name: value for name, value in options.items() if name in options_of(source)}
    made: Input = load_class(INPUTS, source).from_config(config, **taken)
    return made
