"""Check recorded commands against the published limits: ``python -m q2r2_franka.check FILE``.

The robot computes velocities, accelerations and jerks as differences between a command and the positions that it
commanded itself in the earlier periods. This check computes the same differences. The robot drops a command that comes
late, and then goes on with its last acceleration. Each state reports the last position that the robot commanded itself.
Between two states that were read, the check assumes that the robot moves in this way.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from q2r2_control import Array
from q2r2_franka import limits
from q2r2_franka.limits import PERIOD
from q2r2_franka.record import Entry, entries_of
from q2r2_franka.stream import robot_positions

ARMS = "left", "right"
# A share of a limit counts as a violation only if it exceeds 1 by more than this. Smaller excesses are rounding errors,
# because a robot rounds positions to doubles. Even in the jerk, which is a third difference, these errors are far
# smaller than this.
_ROUNDING = 1e-3


@dataclass
class Checked:
    """The result for one arm."""

    commands: int = 0
    motions: int = 0
    lost: int = 0  # Number of periods without a command that came in time.
    # By the name of a limit, the greatest ratio of a number to its limit. A ratio above 1 violates the limit.
    shares: dict[str, float] = field(default_factory=dict)

    @property
    def violated(self) -> list[str]:
        return [name for name, share in self.shares.items() if share > 1.0 + _ROUNDING]

    def see(self, name: str, share: Array | float) -> None:
        greatest = float(np.max(share))
        # A number that is not finite violates every limit. ``max`` alone would ignore NaN.
        self.shares[name] = max(self.shares.get(name, 0.0), greatest if math.isfinite(greatest) else math.inf)


def check_commands(entries: Iterable[Entry]) -> dict[str, Checked]:
    """Return the result for each arm that has commands, by the arm's name."""
    checked: dict[str, Checked] = {}
    # For each arm, the robot's last three positions before its last command, and this command.
    histories: dict[str, list[Array]] = {}
    sent: dict[str, Array] = {}
    for entry in entries:
        arm = ARMS[entry.arm]
        result = checked.setdefault(arm, Checked())
        if entry.begins:
            result.motions += 1
            histories[arm], sent[arm] = [entry.values] * 3, entry.values
            continue
        result.commands += 1
        result.lost += entry.cycles - 1
        if entry.is_torque:
            result.see("torque", np.abs(entry.values) / limits.TORQUE)
            result.see("torque rate", np.abs(entry.values - entry.held) / (limits.TORQUE_RATE * PERIOD))
            continue
        robot, was_dropped = robot_positions(histories[arm], sent[arm], entry.cycles, entry.held)
        result.lost += was_dropped
        histories[arm], sent[arm] = [*robot[:2], entry.held], entry.values
        _check_positions(result, histories[arm], entry.values)
    return checked


def _check_positions(result: Checked, history: list[Array], newest: Array) -> None:
    """Check a position (7,) [rad] after three positions of the robot, all of which are 1 ms apart."""
    oldest, older, before = history
    centre, half = 0.5 * (limits.UPPER + limits.LOWER), 0.5 * (limits.UPPER - limits.LOWER)
    result.see("position", np.abs(newest - centre) / half)
    velocity = (newest - before) / PERIOD
    least, greatest = limits.velocity_limits(before)
    result.see("velocity", np.where(velocity < 0.0, velocity / (least - 1e-9), velocity / (greatest + 1e-9)))
    result.see("acceleration", np.abs(newest - 2.0 * before + older) / PERIOD**2 / limits.ACCELERATION)
    result.see("jerk", np.abs(newest - 3.0 * before + 3.0 * older - oldest) / PERIOD**3 / limits.JERK)


def main(arguments: list[str]) -> int:
    """Print the greatest share of each limit. Return 1 for a violation, 2 if nothing can be checked, else 0."""
    if len(arguments) != 1 or not Path(arguments[0]).is_file():
        print("usage: python -m q2r2_franka.check FILE, a file of plant_settings.franka.record", file=sys.stderr)
        return 2
    try:
        checked = check_commands(entries_of(Path(arguments[0])))
    except (IndexError, KeyError):  # An entry names an arm that does not exist, or no motion has begun before it.
        checked = {}
    if not any(its.commands for its in checked.values()):
        allowed = "allowed: a file of plant_settings.franka.record"
        print(f"{arguments[0]}: no commands, or an entry that cannot be read; {allowed}", file=sys.stderr)
        return 2
    for arm, its in checked.items():
        shares = ", ".join(f"{name} {100.0 * share:.1f} %" for name, share in its.shares.items())
        print(f"{arm}: {its.commands} commands, {its.motions} motions, {its.lost} periods without a command")
        print(f"{arm}: of the limits: {shares}")
    return int(any(its.violated for its in checked.values()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
