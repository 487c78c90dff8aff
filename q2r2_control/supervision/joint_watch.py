"""Judge the measured joints: are they plausible, and do arms of another controller keep their distances?"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from operator import sub

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.config.control import SupervisionSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.events import Reason
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.pairs import pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.supervision.target_stream import StreamSettings, apart
from q2r2_control.types import Array, Reference, RobotState

# Tolerances of the test for jumps: an angle for the noise of the encoders [rad], and a time for stamps that a busy
# machine delays [s].
_JUMP_ALLOWANCE, _JUMP_TIME = 0.05, 0.02
# A joint that moves by less than this during the settle time is at rest [rad].
_REST = 0.01


@dataclass(slots=True)
class WatchSettings:
    """The limits for measured states; they may be changed at run time. See :func:`watch_settings`."""

    timeout: float  # Greatest age of the newest state before the arms stop [s].
    # Time for which states with NaN or infinite numbers are ignored before they are a fault [s].
    unusable_time: float
    settle_time: float  # The arms are activated after the states were good, and the arms rested, for this time [s].
    deviation: float  # Greatest distance of a measured joint from the reference [rad].
    deviation_time: float  # Time for which a joint may be farther away than ``deviation`` [s].


def watch_settings(settings: SupervisionSettings, yields: bool) -> WatchSettings:
    """Return the limits from the cell's settings.

    Args:
        settings: The ``supervision`` block of the cell.
        yields: Whether the drive is compliant, so that a person may push the arms away from the reference.
    """
    return WatchSettings(
        timeout=settings.state_timeout,
        unusable_time=settings.unusable_time,
        settle_time=settings.settle_time,
        deviation=settings.max_deviation_torque if yields else settings.max_deviation,
        deviation_time=settings.deviation_time,
    )


class JointWatch:
    """Judges every measured state. A state's stamp is the time at which its oldest part was received [s].

    Arrays are (nv,).
    """

    def __init__(
        self,
        names: Sequence[str],
        velocity_limit: Array,
        settings: WatchSettings,
        source: Callable[[], str] = lambda: "",
    ) -> None:
        self._names, self._velocity_limit, self._settings = names, velocity_limit, settings
        self._source = source  # Text that names the sender in messages, such as " from /node", or "".
        self.state: RobotState | None = None  # The newest state that was good; None before the first one.
        self.fault: Reason | None = Reason.of(SupervisionReason.NO_STATES_YET, source="")
        self._lost = False  # True if :meth:`lose` has recorded the fault, and all states since then were good.
        self._q: list[float] = []  # Joint positions of ``state`` [rad].
        self._still_since, self._still_at = math.inf, self._q
        self._near_at: float | None = None

    def observe(self, state: RobotState | Reason, now: float, passed: float = 0.0) -> None:
        """Judge a measured state, or record the reason why there is no state.

        Args:
            state: The state, or the reason why the plant has none.
            now: The time of the loop [s].
            passed: Simulated time since the last state, if the plant is simulated [s].
        """
        if isinstance(state, Reason):
            self._fail(state)
            return
        q, external = state.q.tolist(), state.q if state.tau_external is None else state.tau_external
        known = math.isfinite(math.hypot(*q, *state.v.tolist(), *external.tolist()))
        if not known and (fault := self._unusable(state, external)):
            if now - self._stamp > self._settings.unusable_time:
                self._fail(fault)
            return
        (last, last_q), (self.state, self._q) = (self.state, self._q), (state, q)
        if last is None or self._still_since == math.inf:
            self._still_since, self._still_at = now, q
            return
        # No joint has moved farther than the Euclidean distance between the two postures. A comparison with NaN is
        # false, so NaN counts as far.
        far = not math.dist(q, last_q) < _JUMP_ALLOWANCE
        if far and (fault := self._jump(q, last_q, max(now - last.stamp, passed, 0.0))):
            self._fail(fault)
        elif not _all_within(q, self._still_at, _REST):
            self._still_since, self._still_at = now, q

    def lose(self, why: Reason) -> None:
        """Record that the arms cannot be commanded, although their states are still measured."""
        believed = self.believed
        self._fail(why)
        self._lost = believed

    @property
    def believed(self) -> bool:
        """Whether the arms may brake from the newest measured state, even during a fault."""
        return self.fault is None or self._lost

    def settled(self, now: float) -> bool:
        """Return whether the states have been good, and the arms have rested, for the settle time."""
        fresh = now - self._stamp <= self._settings.timeout
        return fresh and now - self._still_since >= self._settings.settle_time

    def check(self, now: float) -> Reason | None:
        """Return the present fault, or None. A state that is too old becomes a fault here."""
        if self.fault is not None:
            return self.fault
        # An age below -timeout is a fault too. After a clock was set back, the newest state seems to come from the
        # future, and would otherwise look fresh for a long time.
        timeout, age = self._settings.timeout, now - self._stamp
        if not -timeout <= age <= timeout:
            self._fail(Reason.of(SupervisionReason.STATES_SILENT, age=age, timeout=timeout, source=self._source()))
        return self.fault

    def deviates(self, reference: Array, now: float) -> Reason | None:
        """Return a reason if a joint has been too far from ``reference`` (nv,) [rad] for too long, else None."""
        assert self.state is not None
        allowed = self._settings.deviation
        if self._near_at is None or _all_within(self._q, reference.tolist(), allowed):
            self._near_at = now
            return None
        deviation = np.abs(self.state.q - reference)
        if now - self._near_at <= self._settings.deviation_time:
            return None
        worst = int(deviation.argmax())
        return Reason.of(
            SupervisionReason.OFF_REFERENCE,
            joint=self._names[worst],
            deviation=float(deviation[worst]),
            time=now - self._near_at,
            allowed=allowed,
            allowed_time=self._settings.deviation_time,
        )

    def accept(self) -> None:
        """Clear the fault, after :meth:`settled` has found that the states are good and the arms rest."""
        self.fault, self._near_at, self._lost = None, None, False

    def accept_at_once(self, state: RobotState, now: float) -> None:
        """Accept ``state`` without waiting, because the caller knows that the arms are at rest in it."""
        self.state, self._q = state, state.q.tolist()
        self._still_since, self._still_at = now, self._q
        self.accept()

    @property
    def _stamp(self) -> float:
        return -math.inf if self.state is None else self.state.stamp

    def _unusable(self, state: RobotState, external: Array) -> Reason | None:
        kind, bridged = SupervisionReason.STATE_NOT_FINITE, 1e3 * self._settings.unusable_time
        for what, values in (("position", state.q), ("velocity", state.v), ("external torque", external)):
            for name, value in zip(self._names, values, strict=True):
                if not math.isfinite(value):
                    return Reason.of(kind, quantity=what, joint=name, value=str(value), bridged=bridged)
        return None

    def _jump(self, q: list[float], last: list[float], time: float) -> Reason | None:
        """Return the fault of a joint that moved farther than it can in ``time`` [s], else None."""
        moved = np.abs(np.subtract(q, last))
        allowed = self._velocity_limit * (time + _JUMP_TIME) + _JUMP_ALLOWANCE
        if not (moved > allowed).any():
            return None
        worst = int((moved - allowed).argmax())
        return Reason.of(SupervisionReason.STATE_JUMPED, joint=self._names[worst], distance=float(moved[worst]))

    def _fail(self, fault: Reason) -> None:
        self._still_since, self._lost = math.inf, False
        # The first fault is kept, because it says most about the cause. Before the first good state, the newest fault
        # says most, and replaces the earlier fault.
        if self.fault is None or self.state is None:
            self.fault = fault


def _all_within(q: list[float], other: list[float], limit: float) -> bool:
    """Return whether all values differ by at most ``limit``; False if one of them is NaN."""
    distance = math.dist(q, other)
    return distance < limit or (math.isfinite(distance) and max(map(abs, map(sub, q, other))) <= limit)


_SLOW = 0.01  # If an arm has no target and its joints are slower than this, it holds its tool's present pose [rad/s].
# How fast the elbows of the reference follow the measured elbows [1/s], [rad/s].
_FOLLOW = {"posture_gain": 10.0, "posture_speed": 1.5}


@dataclass(slots=True)
class ExternalSettings:
    """The limits for arms that another controller moves; they may be changed at run time."""

    tolerance: float = 0.01  # Two measured bodies may be closer than their required distance by this much [m].


def settings_for_external_arms(config: Config) -> Config:
    """Return the cell's configuration for arms that another controller moves.

    The elbows of the reference are free to follow the measured elbows. A joint may deviate from the reference by
    ``max_deviation_external``, because the other controller lags. Arms that come too close are found by their measured
    distances.
    """
    control = config.control.model_copy(update=_FOLLOW)
    # The admittance is off, because the other controller already yields to forces.
    stiff = config.admittance.model_copy(update={"enabled": False})
    supervision = config.supervision
    lagging = supervision.model_copy(update={"max_deviation": supervision.max_deviation_external})
    return config.model_copy(update={"control": control, "admittance": stiff, "supervision": lagging})


class ExternalArms:
    """Targets and checks for arms that another controller moves along our reference.

    The reference keeps the real arms apart only if they are at its posture. The other controller follows the tool poses
    and chooses the positions of the elbows itself. For that reason the elbows of the reference follow the measured
    elbows, and an arm without a target holds its tool's pose instead of its joint positions. The measured distances are
    checked as well. They may be smaller than the required distances by a tolerance, because the arms lag.
    """

    def __init__(
        self,
        robot: Robot,
        controller: CartesianController,
        settings: ExternalSettings,
        streams: StreamSettings,
        watch: WatchSettings,
    ) -> None:
        self._robot, self._controller, self._settings = robot, controller, settings
        self._streams, self._watch = streams, watch
        self._keys = kept_distances(robot, controller.settings).keys
        self._near_at: dict[str, float] = {}  # Time at which each arm's tool was last near its reference [s].
        self._held: dict[str, pin.SE3] = {}

    def begin(self) -> None:
        self._held.clear()
        self._near_at.clear()

    def targets(self, wanted: dict[str, pin.SE3 | None], last: Reference | None) -> dict[str, pin.SE3 | None]:
        """Return the ``wanted`` targets, by arm.

        If an arm has no target and rests in the ``last`` reference, its target is the tool's pose in this reference.
        """
        for arm, pose in wanted.items():
            if pose is not None:
                self._held.pop(arm, None)
            elif arm not in self._held and (last is None or np.abs(last.v[self._robot.arms[arm].joints]).max() < _SLOW):
                self._held[arm] = self._controller.tool_pose(arm)
        return {arm: self._held.get(arm, pose) for arm, pose in wanted.items()}

    def left_behind(self, state: RobotState, holding: Iterable[str], now: float) -> Reason | None:
        """Return a reason if an arm without a target has been too far from the reference for too long, else None.

        The measured tool pose is compared with the tool pose in the reference. The other controller does not move such
        an arm to the reference. The operator could not engage it either: an operator's targets begin at the measured
        tool pose, but they would have to begin at the tool pose in the reference.

        Args:
            state: The measured state.
            holding: The arms without a target.
            now: The time [s].
        """
        holding = set(holding)
        for arm in self._robot.arms:
            measured, commanded = self._robot.tool_pose(state.q, arm), self._controller.tool_pose(arm)
            distance, turn = apart(measured, commanded)
            near = distance <= self._streams.engage_distance and turn <= self._streams.engage_angle
            if near or arm not in holding or arm not in self._near_at:
                self._near_at[arm] = now
            elif now - self._near_at[arm] > self._watch.deviation_time:
                return Reason.of(SupervisionReason.LEFT_BEHIND, arm=arm, distance=distance, angle=turn)
        return None

    def too_close(self, state: RobotState) -> Reason | None:
        """Return a reason if a measured pair of bodies is closer than allowed, else None."""
        distances, kept = self._robot.distance_values(state.q), self._controller.kept_distances
        if (distances - kept).min(initial=np.inf) >= -self._settings.tolerance:
            return None
        tightest = int(np.argmin(distances - kept))
        least, tolerance = kept[tightest], self._settings.tolerance
        return Reason.of(
            SupervisionReason.TOO_CLOSE,
            pair="|".join(pair_names(self._robot.collision_model)[tightest]),
            distance=float(distances[tightest]),
            allowed=float(least - tolerance),
            key=self._keys[tightest],
            kept=float(least),
            tolerance=tolerance,
        )
