"""One or two Franka arms as a plant. A separate process answers the robots, and gets the arms' motion from the loop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from q2r2_control import Array, Command, CommandMode, Config, ConfigError, PlantError, Reason, Robot, RobotState
from q2r2_control.plants import ArmTiming, check_command
from q2r2_franka.answering import RobotAnswers
from q2r2_franka.cell import FrankaCell
from q2r2_franka.hand import Hand
from q2r2_franka.limits import JOINTS, PERIOD
from q2r2_franka.settings import FrankaSettings, franka_settings, is_loopback
from q2r2_franka.state import SessionState
from q2r2_franka.stream import MEANS

# The mean of n positions that are h = 1 ms apart is at most A (n^2 - 1) h^2 / 24 from the path, where A is the limit of
# the acceleration. For a jerk limit j, the distances that pairs keep allow the mean to be A W^2 / 4 from the path. W is
# the largest 2 A / j of all joints (robot/command_average.py of q2r2_control). This is enough if j is at most this
# multiple of 2 A / (n h).
_LARGEST_JERK_LIMIT = MEANS / math.sqrt((MEANS**2 - 1) / 6.0)
_LOOKS = 0.01  # Time between two checks of the robots during a wait [s].


class FrankaPlant:
    """A plant of real arms. Each motion starts at the present posture, even if a robot ended the previous one."""

    modes: tuple[CommandMode, ...] = (CommandMode.TORQUE, CommandMode.POSITION)
    settings = FrankaSettings
    realtime_only = True
    # Each commanded position is the mean of MEANS positions of the path, so the plant itself keeps control.jerk_limit.
    averages = True
    # Longest times that a reset waits for a state of each robot, and until all motions have begun [s]. If some motions
    # have not begun by then, the run begins nevertheless.
    longest_wait = longest_session_wait = 10.0

    def __init__(self, robot: Robot, config: Config) -> None:
        """Make the plant.

        Raises:
            ConfigError: If an arm has no robot in the settings or does not have seven joints, if a late tick would be
                split into several steps, or if the limit of jerk is too low.
        """
        self._settings = franka_settings(config)
        for arm, its in robot.arms.items():
            if arm not in self._settings.arms:
                raise ConfigError(
                    f"plant_settings.franka.{arm}: missing; allowed: the robot of each arm, as {{address: 172.16.0.2}}"
                )
            if len(its.joints) != JOINTS:
                raise ConfigError(
                    f"plant_settings.franka.{arm}: the arm has {len(its.joints)} joints; allowed: {JOINTS}"
                )
        self._robot = robot
        self._period, self._longest = 1.0 / config.nominal_rate_hz, config.control.max_substep
        if self._longest < 2.0 * self._period:
            allowed = "allowed with robots: two ticks of loop_rate_hz or more, such as 0.01"
            raise ConfigError(f"control.max_substep = {self._longest:g}: {allowed}")
        limit = config.control.jerk_limit
        kept = 2.0 * robot.capped_acceleration(config.control.acceleration_limit) / (MEANS * PERIOD)
        if limit is not None and not 1.0 <= float((limit / kept).min()) <= _LARGEST_JERK_LIMIT:
            # The mean of positions cannot keep a smaller limit. With a larger limit, W is shorter. The distances that
            # pairs keep would then not allow for the whole distance of the mean from the path.
            largest = math.floor(_LARGEST_JERK_LIMIT * kept.max())
            raise ConfigError(
                f"control.jerk_limit = {limit}: allowed with robots: {kept.max():.0f} to {largest} rad/s^3, with the "
                "acceleration limits of this cell"
            )
        self.begin(CommandMode.POSITION)
        self._answering: RobotAnswers | None = None
        self._hands: dict[str, Hand] = {}

    @classmethod
    def from_config(cls, robot: Robot, config: Config) -> FrankaPlant:
        return cls(robot, config)

    @classmethod
    def drives_real_arms(cls, config: Config) -> bool:
        """See :class:`q2r2_control.plants.RealPlant`. A robot at a loopback address is simulated."""
        return not all(is_loopback(its.address) for its in franka_settings(config).arms.values())

    def begin(self, mode: CommandMode, stopped: Callable[[], bool] = lambda: False) -> None:
        """See :meth:`SessionPlant.begin`."""
        self._mode, self._stopped = mode, stopped

    def reset(self, q: Array | None = None) -> None:
        """Connect to the robots, and begin their motions.

        Raises:
            PlantError: If a robot is not reached, or if ``q`` is given, because real arms cannot be placed.
        """
        if q is not None:
            raise PlantError("reset q: a real arm starts where it stands")
        self.close()
        states = [SessionState(arm, its.address, self._mode) for arm, its in self._settings.arms.items()]
        self.cell = FrankaCell(self._robot, states, self._period, self._longest)
        limits = {arm: self._robot.torque_limit[self._robot.arms[arm].joints] for arm in self._settings.arms}
        self._answering = RobotAnswers(self._settings, self._mode, limits)
        self._hands = {
            arm: Hand(arm, its.address, its.hand) for arm, its in self._settings.arms.items() if its.hand is not None
        }
        try:
            self._wait()
        except PlantError:
            self.close()
            raise

    def _wait(self) -> None:
        """Wait for the robots. Raises :class:`PlantError` if a robot cannot be reached."""
        began = time.monotonic()
        while not self.cell.is_heard or self._looks_for_fault() is not None:
            passed = time.monotonic() - began
            if self._stopped() or passed >= (self.longest_session_wait if self.cell.is_heard else self.longest_wait):
                break
            time.sleep(_LOOKS)
            self.due(time.monotonic())
        if not self.cell.is_heard:
            problem = self._looks_for_fault()
            why = "" if problem is None else problem.kind.template.format(**problem.detail)
            raise PlantError(f"{why}; waited for {time.monotonic() - began:.1f} s")

    def _looks_for_fault(self) -> Reason | None:
        return next((why for its in self.cell.states.values() if (why := its.fault(time.monotonic()))), None)

    def due(self, now: float) -> tuple[float, float]:
        """See :meth:`SessionPlant.due`. Raises :class:`PlantError` if the process that answers the robots has ended."""
        assert self._answering is not None
        for state in self._answering.receive():
            self.cell.update(state)
        return self.cell.due(now)

    def withdraws(self) -> bool:
        """See :meth:`SessionPlant.withdraws`."""
        return self.cell.withdraws()

    def delay(self) -> float:
        """See :meth:`SessionPlant.delay`."""
        return self.cell.delay()

    def timings(self) -> dict[str, ArmTiming]:
        """See :meth:`SessionPlant.timings`."""
        return self.cell.timings()

    def lead(self) -> float:
        """See :meth:`SessionPlant.lead`."""
        return self.cell.lead()

    def fault(self) -> Reason | None:
        """See :meth:`SessionPlant.fault`."""
        return self.cell.fault()

    def sessions(self) -> dict[str, str]:
        return {arm: state.words for arm, state in self.cell.states.items()}

    def apply(self, command: Command) -> None:
        check_command(command, self._robot, self.modes)
        assert self._answering is not None
        self.cell.sent(self._answering.send(self.cell.apply(command)))
        for arm, hand in self._hands.items():
            if arm in command.grippers:
                hand.command(float(command.grippers[arm]))

    def advance(self, dt: float) -> None:
        """Do nothing, because the time of real arms passes by itself."""

    def state(self) -> RobotState:
        return self.cell.state()

    def gripper_openings(self) -> dict[str, float]:
        """See :meth:`Plant.gripper_openings`. Before a run, hands that will be measured count as open."""
        if self._answering is None:
            return {arm: 1.0 for arm, its in self._settings.arms.items() if its.hand is not None}
        return {arm: opening for arm, hand in self._hands.items() if (opening := hand.opening) is not None}

    def close(self) -> None:
        if self._answering is not None:
            self._answering.close()
            self._answering = None
            for hand in self._hands.values():
                hand.close()
            self._hands = {}
