"""What every mode of driving a plant has: from tool targets and a reference to a command."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.compliance.admittance import AdmittanceReport
from q2r2_control.compliance.impedance import ImpedanceReport
from q2r2_control.compliance.repulsion import WallReport
from q2r2_control.config.control import ControllerSettings
from q2r2_control.types import Array, Command, CommandMode, Interval, Reference, RobotState

ToolTargets = dict[str, pin.SE3 | None]
Openings = dict[str, float]


@dataclass(slots=True)
class DriveReport:
    """What the mode's own laws did in one tick; None for those of the other modes, or not enabled."""

    impedance: ImpedanceReport | None = None
    wall: WallReport | None = None
    admittance: AdmittanceReport | None = None


class Drive(ABC):
    """One mode of driving a plant. What stops the arms is not decided here but in ``supervision``."""

    mode: CommandMode
    report: DriveReport  # of the last tick
    yields = False  # whether arms that are pushed leave the reference by design
    coasts = False  # whether a plant goes on moving by the last command while none comes

    @abstractmethod
    def reset(self, state: RobotState) -> None:
        """Start anew, at rest at the measured ``state``. Raises :class:`Q2R2Error` where that cannot be."""

    @abstractmethod
    def command(
        self, reference: Reference, state: RobotState, grippers: Openings, dt: float, trusted: bool = True
    ) -> Command:
        """What goes to the plant in a tick of ``dt`` [s]; never raises because of a number.

        ``trusted`` is False where ``state`` is out of date or not to be believed, and for the last command before there
        are no more: what pushes according to the state must not push then.
        """

    def set_openings(self, openings: Mapping[str, Interval]) -> None:  # noqa: B027
        """Between which openings each arm's gripper is, as the controller has accepted it."""

    def set_holding(self, holding: Mapping[str, bool]) -> None:  # noqa: B027
        """Of each arm whose gripper has an object, whether it is held."""

    def set_kept_distances(self, kept: Array) -> None:  # noqa: B027
        """How far apart every pair stays from now on, (p,) [m], as the controller's settings were changed."""

    def displaced(self, targets: ToolTargets, state: RobotState, dt: float) -> ToolTargets:
        """The tool targets that the controller is to follow in a tick of ``dt`` [s]."""
        return targets

    def at_rest(self, state: RobotState) -> bool:
        """Whether the arms stand still, given that the reference does."""
        return True

    def last_command(self, state: RobotState, grippers: Openings) -> Command | None:
        """What holds the arms when no more commands come; None: the last one does."""
        return None


def permitted(settings: ControllerSettings, drive: Drive) -> ControllerSettings:
    """What of the controller's settings a drive permits: only where arms yield may bodies touch."""
    return settings if drive.yields else settings.without_contact()


def position_command(reference: Reference, grippers: Openings) -> Command:
    """The reference itself."""
    return Command(CommandMode.POSITION, reference.q, reference.v, np.zeros(len(reference.q)), grippers)


def holding_command(q: Array, grippers: Openings) -> Command:
    """Stand still at ``q`` (nv,) [rad], held by the plant's own servos."""
    zero = np.zeros_like(q)
    return Command(CommandMode.POSITION, q, zero, zero, grippers)
