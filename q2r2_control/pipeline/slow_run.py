"""Move arms slowly, to given postures or with simulated hands, while a person at a terminal watches.

The pipeline runs in a thread of its own, gives every guarantee of an ordinary run, and holds the arms between
the motions. The speed limits of its controller are 5 % of the joints' limits, so that nothing can move faster.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from threading import Thread
from types import TracebackType
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control.config.bindings import Action, BindingSettings
from q2r2_control.config.cell import Config
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.errors import PlantError
from q2r2_control.events import CommonReason, Reason
from q2r2_control.inputs.played import EvenSampling, PlayedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.base import Plant
from q2r2_control.process.scheduling import real_time, stop_on_signals
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.unchecked import check_watched
from q2r2_control.summary.tick import Tick
from q2r2_control.supervision.supervisor import Phase
from q2r2_control.types import SIDES, Array, HandInputs
from q2r2_control.wording import sentence

SPEED = 0.05  # Share of the joints' speed limits.
HAND_SPEED = 0.03  # Upward speed of the simulated hands [m/s].
_PATIENCE = 20.0  # Longest duration of a motion, of the wait for sessions, and of the wait for rest [s].
STILL, REST = 2e-3, 0.3  # Joints at rest move less than this [rad] in this time [s].
_LOOKS = 0.05  # Time between two checks [s].
_RATE = 75.0  # Rate of the hands' samples [Hz].


class _Hands(PlayedInput):
    """Both simulated hands. A hand rests until its button is held. Then its arm is engaged, and the hand moves up."""

    def __init__(self) -> None:
        self.held: tuple[str, ...] = ()  # The hands whose buttons are held.
        self._height = dict.fromkeys(SIDES, 1.0)  # Height of each hand [m].
        super().__init__(self._posed, self._pressed, {hand: EvenSampling(_RATE) for hand in SIDES})

    def _posed(self, hand: str, t: float) -> pin.SE3:
        self._height[hand] += (hand in self.held) * HAND_SPEED / _RATE
        return pin.SE3(np.eye(3), np.array([0.0, 0.0, self._height[hand]]))

    def _pressed(self, hand: str, t: float) -> HandInputs:
        return HandInputs(press_middle=float(hand in self.held))


class Moment(NamedTuple):
    """The state in one tick. Joints are (nv,) [rad]."""

    now: float  # Time by the loop's clock [s].
    q: Array  # Measured positions.
    tau: Array  # Measured torques [Nm].
    external: Array  # Torques that the cabinet's model does not explain [Nm]; NaN if the cabinet does not report them.
    reference: Array  # Positions of the reference.
    v: Array  # Velocities of the reference [rad/s].
    deceleration: Array | None  # Deceleration of the certified stop from the reference [rad/s^2].
    engaged: dict[str, bool]  # For each arm, whether it follows a hand.


class SlowRun:
    """A context manager that moves the arms of ``plant``. At its end, the arms come to rest, and the plant is closed.

    Every method raises :class:`PlantError` if the arms do not do what they are asked to do. The method may be called
    again as long as :attr:`is_over` is False.
    """

    def __init__(
        self,
        config: Config,
        plant: Callable[[Robot, Config], Plant],
        realtime: bool = True,
        listener: Callable[[Moment], None] | None = None,
    ) -> None:
        """Make a slow run; ``listener`` gets each tick's moment in the loop's own thread."""
        control = config.control.model_copy(update={"velocity_scale": SPEED})
        teleop = TeleopSettings(bindings=BindingSettings(lower=Action.NONE, grip=Action.DEAD_MAN))
        slow = config.model_copy(update={"control": control, "teleop": teleop})
        self.robot = Robot.from_config(slow)
        check_watched(self.robot, config.name)
        self._hands = _Hands()
        self._pipeline = Pipeline(slow, self.robot, self._hands, plant(self.robot, slow))
        self._pipeline.listeners.append(self._look)
        self._thread = Thread(target=self._run, args=(realtime,), name="slow run")
        self._listener = listener
        self._error: BaseException | None = None
        self._goal: Array | None = None  # The next goal (nv,) [rad]; None after the loop has taken it.
        self._newest: Moment | None = None
        self._rest: Moment  # The first moment of the present rest.
        self._moments: list[Moment] | None = None  # The moments of the present motion; None between motions.
        self._lost: Reason | None = None  # Why the arms were not commanded any more in this motion, or None.

    def __enter__(self) -> SlowRun:
        self._thread.start()
        try:
            self._wait_for_sessions()
        except BaseException:
            self._end_run()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end_run()

    def _end_run(self) -> None:
        with stop_on_signals(self._pipeline.stop):  # A signal does not interrupt the stop of the arms.
            self._pipeline.stop()
            self._thread.join()

    @property
    def reference(self) -> Array:
        """Joint positions of the newest reference (nv,) [rad]."""
        assert self._newest is not None
        return self._newest.reference

    @property
    def is_over(self) -> bool:
        """True if a fault has ended the run. The arms can then no longer be moved by :meth:`lead_to`."""
        return not self._thread.is_alive()

    def lead_to(self, goal: Array) -> list[Moment] | None:
        """Move all joints straight to ``goal`` (nv,) [rad], and wait until they rest.

        Return the moments of all ticks from rest to rest; None if the straight path is not free; then nothing has
        moved.
        """
        homing = self._pipeline.supervisor.homing
        self._begin()
        homing.outcome, self._goal = None, goal.copy()
        self._wait(lambda: self._goal is None and not homing.active)
        outcome = self._pipeline.supervisor.homing.outcome
        kind = None if outcome is None else outcome.kind
        if kind is CommonReason.HOMING_NO_WAY:
            return None
        if kind is not CommonReason.HOMING_ARRIVED:
            self._fail("the way there was ended" if outcome is None else sentence(outcome))
        return self._end()

    def let_go(self, arms: Sequence[str], duration: float) -> list[Moment]:
        """Let the hands of ``arms`` move up for ``duration`` [s], and then release the buttons.

        Return the moments from rest to rest.
        """
        self._begin()
        self._hands.held = tuple(self._pipeline.teleop.hand_of(arm) for arm in arms)
        try:
            end = self._now + duration
            self._wait(lambda: self._now >= end)
        finally:
            self._hands.held = ()
        return self._end()

    def _begin(self) -> None:
        self._moments = self._lost = None
        self._wait_for_sessions()
        assert self._newest is not None
        self._rest, self._moments = self._newest, [self._newest]

    def _end(self) -> list[Moment]:
        moments = self._moments
        assert moments is not None
        self._wait(lambda: moments[-1].now - self._rest.now >= REST)
        self._moments = None
        return moments

    def _wait_for_sessions(self) -> None:
        self._wait(lambda: self._phase is Phase.ACTIVE and self._newest is not None)

    @property
    def _phase(self) -> Phase:
        return self._pipeline.supervisor.phase

    def _run(self, realtime: bool) -> None:
        try:
            # A loop that never sleeps must not have priority, because other threads would get no processor.
            with real_time() if realtime else nullcontext():
                self._pipeline.run(realtime=realtime)
        except BaseException as error:
            self._error = error

    def _look(self, tick: Tick) -> None:
        """Observe a tick. This runs in the loop's own thread."""
        moment = Moment(
            tick.now,
            tick.state.q,
            tick.state.tau,
            np.full_like(tick.state.tau, np.nan) if tick.state.tau_external is None else tick.state.tau_external,
            tick.reference.q,
            tick.reference.v,
            tick.command.deceleration,
            tick.engaged,
        )
        self._newest = moment
        if self._moments is not None:
            # The fault is stored, because the session may be back before the main thread notices its loss.
            if self._phase is not Phase.ACTIVE and self._lost is None:
                self._lost = self._pipeline.supervisor.fault
            self._moments.append(moment)
            moved = np.abs((moment.q - self._rest.q, moment.reference - self._rest.reference)).max()
            if moved > STILL:
                self._rest = moment
        if self._goal is not None:
            self._pipeline.supervisor.go_home(self._goal)
            self._goal = None
        if self._listener is not None:
            self._listener(moment)

    @property
    def _now(self) -> float:
        """Return the time of the newest tick by the loop's clock [s]; 0 before the first tick."""
        return 0.0 if self._newest is None else self._newest.now

    def _wait(self, until: Callable[[], bool]) -> None:
        end = math.inf
        while True:
            if self._lost is not None or self.is_over:
                self._fail("the run has ended")
            if until():
                return
            if self._now > end:
                self._fail(f"not done within {_PATIENCE:g} s")
            if end == math.inf and self._newest is not None:
                end = self._now + _PATIENCE
            time.sleep(_LOOKS)

    def _fail(self, otherwise: str) -> None:
        """Raise :class:`PlantError` with the reason why the run ended, or why the arms are not commanded."""
        while self._phase in (Phase.BRAKING, Phase.STOPPED) and not self.is_over:
            time.sleep(_LOOKS)
        if self.is_over:
            raise PlantError(str(self._error)) from self._error
        fault = self._lost or self._pipeline.supervisor.fault
        raise PlantError(otherwise if fault is None else sentence(fault))


def resting(moments: list[Moment]) -> list[Moment]:
    """Return the last moments of a motion, in which the arms rested."""
    return [moment for moment in moments if moments[-1].now - moment.now <= REST]
