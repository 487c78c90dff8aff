"""The interface of every source of hand samples: a script, the headset, a recording."""

from __future__ import annotations

from types import NoneType
from typing import Protocol, runtime_checkable

import numpy as np

from q2r2_control.config.cell import Config
from q2r2_control.config.plugin_settings import check_block
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
    """A source of hand samples. The thread of the control loop polls it once per tick.

    The order of use is ``start``, then ``poll`` and ``send_haptic`` in any order, then ``close``. An input that is
    found by its name also has a class method ``from_config(config)``. Its class may have these further attributes:

    - ``settings``: The :class:`StrictModel` of its block in ``input_settings``. The block is checked by it before
      ``from_config`` is called, and by ``q2r2 check``.
    - ``options``: The names of keyword arguments of ``from_config``. Each is an option of ``q2r2 run``, except
      ``say``, which is a function that prints a line.
    - ``cell``: A function that gives a cell the settings that this input needs, such as the input's own axes.
    - ``executable``: The ROS executable that is started for this input instead of ``hand_input``.
    - ``feels``: False if there is no device that could vibrate. No vibrations are then computed.
    - ``simulated``: True if the samples depend only on the times of the polls, so that a run may be in simulated time.
    """

    controls: DeviceControls  # The buttons and axes that the samples of this input have.

    @property
    def connected(self) -> bool:
        """Whether samples can arrive now. The loop reports every change from True to False to the teleop layer."""

    def start(self) -> None:
        """Begin to receive, and return at once.

        Raises:
            Q2R2Error: If the source cannot be opened.
        """

    def poll(self, now: float) -> list[HandSample]:
        """Return the samples that were received since the last poll, oldest first. The list is empty if there are none.

        ``now`` [s] is on the clock of the samples' stamps. The method never waits, and never raises because of received
        data. The input must not change a returned sample, because other objects keep it for some ticks.
        """

    def send_haptic(self, feedback: HapticFeedback) -> None:
        """Vibrate a hand controller, if the source has one. The method never waits."""

    def close(self) -> None:
        """Release every resource. The method may be called twice."""


@runtime_checkable
class PolicySource(Input, Protocol):
    """An input that also gives the actions of a policy. In each run, ``prepare`` is called before ``start``."""

    def prepare(self, robot: Robot, realtime: bool) -> None:
        """Prepare for a run of ``robot``. If ``realtime`` is False, the loop has to wait for the policy's answers."""

    def chunks(self) -> list[ActionChunk]:
        """Return the chunks that came since the previous call, oldest first. The method never waits or raises."""

    def observe(self, observation: Observation) -> None:
        """Give the policy the observation of a tick, which does not change later. In real time, this never waits."""


def check_samples(samples: list[HandSample]) -> list[HandSample]:
    """Check the types in the ``samples`` of a poll, and return the samples. Their numbers may have any value.

    Raises:
        InputError: If ``samples`` is not a list of HandSample, or if a field of a sample has a wrong type.
    """
    check_kind("poll() of the input", samples, list, "a list of HandSample", InputError)
    for sample in samples:
        check_kind("a sample of the input", sample, HandSample, "a HandSample", InputError)
        for name, kind, allowed in _SAMPLE:
            check_kind(f"{name} of a sample of the input", getattr(sample, name), kind, allowed, InputError)
    return samples


def options_of(source: str) -> tuple[str, ...]:
    """Return the options of the input called ``source``; raises :class:`ConfigError` if the name is unknown."""
    return tuple(getattr(load_class(INPUTS, source), "options", ()))


def is_simulated(source: str) -> bool:
    """Return whether the input called ``source`` can be polled in simulated time.

    Raises:
        ConfigError: If the name is unknown.
    """
    return bool(getattr(load_class(INPUTS, source), "simulated", False))


def adapted(source: str, config: Config) -> Config:
    """Return the cell with the settings that an input needs, such as its bindings. ``q2r2 run`` also calls this.

    Args:
        source: The name of an installed input.
        config: The cell, which is not changed.

    Raises:
        ConfigError: If the name is unknown.
    """
    adapt = getattr(load_class(INPUTS, source), "cell", None)
    return config if adapt is None else adapt(config)


def make_input(source: Input | str, config: Config, **options: object) -> Input:
    """Return the input called ``source``, or ``source`` itself if it is an input.

    The input receives nothing before ``start``.

    Args:
        source: The name of an installed input, such as ``headset``, or an object with all methods of :class:`Input`.
        config: The cell that the input moves.
        options: Keyword arguments of the input's ``from_config``, such as ``trajectory="circle"``. Options
            that the input does not have are ignored.

    Raises:
        ConfigError: If the name is unknown, if ``source`` is neither a name nor an input, if the input refuses an
            option, or if a value in its block of ``input_settings`` is not allowed.
    """
    if not isinstance(source, str):
        check_kind("input", source, Input, "the name of an input, or an object with all methods of Input")
        return source
    taken = {name: value for name, value in options.items() if name in options_of(source)}
    found = load_class(INPUTS, source)
    check_block("input_settings", source, found, config.input_settings)
    made: Input = found.from_config(config, **taken)
    return made
