"""Whether a replay does what was recorded, bit for bit; and what around it is not as it was."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import yaml

from q2r2_control.config.cell import Config
from q2r2_control.recording.about import About, as_yaml, program
from q2r2_control.recording.recorded_ticks import RecordedTicks
from q2r2_control.recording.tick_rows import NOT_REPLAYED, TickPacker, tick_labels
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick


class Comparison:
    """A listener of a replay that holds each tick to the recorded one. How long a tick took is left out."""

    keeps_episodes = True  # as when it was recorded

    def __init__(self, about: About, ticks: RecordedTicks) -> None:
        self._ticks, self._packer = ticks, TickPacker(about.arms, about.joints)
        self._labels = tick_labels(about.arms, about.joints)
        left_out = [any(name in label.split(".") for name in NOT_REPLAYED) for label in self._labels]
        self._compared = np.flatnonzero(~np.array(left_out))
        self._difference: str | None = None

    def __call__(self, tick: Tick) -> None:
        """Take one tick of the replay."""
        recorded = self._ticks.current
        assert recorded is not None
        replayed = self._packer.pack(recorded.number, tick)
        if self._difference is None:
            found = self._difference_of_rows(recorded.packed.row, replayed.row)
            found = found or _difference_of_states(recorded.packed.state, replayed.state)
            if found is not None:
                self._difference = f"{tick.now - self._ticks.start.now:.6f} s: {found}"

    def finish(self) -> str | None:
        """The first difference, after the replay, of which nothing may be left; None: there is none."""
        if self._difference is None and self._ticks.next is not None:
            return f"{self._ticks.next.now - self._ticks.start.now:.6f} s: a tick was recorded only"
        return self._difference

    def _difference_of_rows(self, recorded: bytes, replayed: bytes) -> str | None:
        """The first number that is not the same to the bit."""
        before, after = (np.frombuffer(row)[self._compared] for row in (recorded, replayed))
        differs = np.flatnonzero(before.view(np.uint64) != after.view(np.uint64))
        if not len(differs):
            return None
        place = int(differs[0])
        return f"{self._labels[self._compared[place]]}: recorded {before[place]}, replayed {after[place]}"


def _difference_of_states(recorded: str, replayed: str) -> str | None:
    """The first key of two JSON texts that is not the same."""
    if recorded == replayed:
        return None
    before, after = (json.loads(text) if text else {} for text in (recorded, replayed))
    for name in {**before, **after}:
        if before.get(name) != after.get(name):
            return f"{name}: recorded {before.get(name)!r}, replayed {after.get(name)!r}"
    return "state: told another time"


def changes(about: About, config: Config, robot: Robot) -> list[str]:
    """What is not as it was when a run was recorded: program, libraries, cell, robot; a line each."""
    now = program()
    found = [
        f"{name}: {about.notes[name]} when recorded, now {now.get(name, 'unknown')}"
        for name in ("version", "revision", "libraries")
        if name in about.notes and about.notes[name] != now.get(name)
    ]
    if about.cell != as_yaml(config):
        old, new = dict(_flat(yaml.safe_load(about.cell))), dict(_flat(yaml.safe_load(as_yaml(config))))
        for key in dict.fromkeys((*old, *new)):
            if old.get(key) != new.get(key):
                found.append(f"cell: {key}: {old.get(key, 'nothing')} when recorded, now {new.get(key, 'nothing')}")
    if about.robot != robot.urdf:
        found.append("the robot's description is not the recorded one")
    return found


def _flat(data: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(data, Mapping) and data:
        for name, value in data.items():
            yield from _flat(value, f"{key}.{name}" if key else str(name))
    else:
        yield key, data
