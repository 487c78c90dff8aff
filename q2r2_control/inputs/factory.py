"""Inputs by name."""

from __future__ import annotations

from q2r2_control.config.cell import Config
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.base import Input
from q2r2_control.inputs.hands_watch import HandsWatch
from q2r2_control.inputs.headset import HeadsetServer
from q2r2_control.inputs.scripted import ScriptedInput

INPUTS = ("scripted", "headset")
DEFAULT_TRAJECTORY = "meet"


def hands_watch(config: Config) -> HandsWatch:
    """What a cell wants to be watched of a headset's hands."""
    headset = config.headset
    return HandsWatch(headset.frozen_time, headset.watch_frame, config.teleop.gate.timeout)


def make_input(source: Input | str, config: Config) -> Input:
    """The input called ``source``, or ``source`` itself. Raises :class:`ConfigError` for an unknown name."""
    if source == "scripted":
        return ScriptedInput(DEFAULT_TRAJECTORY)
    if source == "headset":
        headset = config.headset
        return HeadsetServer(headset.host, headset.port, allow=headset.networks, watch=hands_watch(config))
    if isinstance(source, str):
        raise ConfigError(f"input {source!r}: allowed are {', '.join(INPUTS)}")
    return source
