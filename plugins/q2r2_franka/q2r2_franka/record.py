"""A file with every command that was sent to the arms, for :mod:`check`."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from q2r2_control import Array

_ENTRY = struct.Struct("<BBBHd7d7d")


class Entry(NamedTuple):
    """One command, or the beginning of a motion."""

    arm: int  # 0 for left, 1 for right.
    begins: bool  # True at the beginning of a motion. Then ``values`` are what the robot holds by itself.
    is_torque: bool
    # Number of periods since the previous entry. Only in the last of these periods, the robot got a command.
    cycles: int
    time: float  # Time by the monotonic clock [s].
    values: Array  # Positions [rad] or torques [Nm] (7,).
    # Positions [rad] or torques [Nm] (7,) that the robot itself commanded last. The state that this command answers has
    # reported them.
    held: Array


def write_entry(file: BinaryIO, entry: Entry) -> None:
    head = entry.arm, entry.begins, entry.is_torque, min(entry.cycles, 0xFFFF), entry.time
    file.write(_ENTRY.pack(*head, *entry.values, *entry.held))


def entries_of(path: Path) -> Iterator[Entry]:
    """Yield all complete entries of a file."""
    data = path.read_bytes()
    for arm, begins, is_torque, cycles, time, *values in _ENTRY.iter_unpack(
        data[: len(data) // _ENTRY.size * _ENTRY.size]
    ):
        joints = np.array(values).reshape(2, -1)
        yield Entry(arm, bool(begins), bool(is_torque), cycles, time, joints[0], joints[1])
