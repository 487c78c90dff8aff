"""Judge measured joints: whether they can be believed, and whether arms that others move keep apart."""

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
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.pairs import pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.supervision.target_stream import StreamSettings, apart
from q2r2_control.types import Array, Reference, RobotState

# Above what the joints may move between two states: noise, and stamps that a busy machine spreads.
_JUMP_ALLOWANCE, _JUMP_TIME = 0.05, 0.02  # [rad], [s]
# The motion that counts as rest during the time that states have to be good before they are believed [rad].
_REST = 0.01


@dataclass(slots=True)
class WatchSettings:
    """The rules for measured states; may be changed at run time. See :func:`watch_settings`."""

    timeout: float  # without a state for this long is a fault [s]
    # States that are not finite are bridged for this long [s]; 0: the first one is a fault.
    unusable_time: float
    settle_time: float  # that states have to be good and at rest before the arms are activated [s]
    deviation: float  # of a joint from the reference [rad]
    deviation_time: float  # [s]


def watch_settings(settings: SupervisionSettings, yields: bool) -> WatchSettings:
    """The rules of the cell's settings; ``yields``: whether arms that are pushed leave their reference by design."""
    return WatchSettings(
        timeout=settings.state_timeout,
        unusable_time=settings.unusable_time,
        settle_time=settings.settle_time,
        deviation=settings.max_deviation_torque if yields else settings.max_deviation,
        deviation_time=settings.deviation_time,
    )


class JointWatch:
    """Looks at every measured state, whose stamp is when its oldest part was received [s]; arrays are (nv,)."""

    def __init__(
        self,
        names: Sequence[str],
        velocity_limit: Array,
        settings: WatchSettings,
        source: Callable[[], str] = lambda: "",
    ) -> None:
        self._names, self._velocity_limit, self._settings = names, velocity_limit, settings
        self._source = source  # where states come from, as " from /node", or ""
        self.state: RobotState | None = None  # the newest that was good
        self.fault: Reason | None = Reason.of(ReasonKind.NO_STATES_YET, source="")
        self._lost = False  # the fault is that arms could not be commanded, and all states since were good
        self._q: list[float] = []  # of that state [rad]
        self._still_since, self._still_at = math.inf, self._q
        self._near_at: float | None = None

    def observe(self, state: RobotState | Reason, now: float, passed: float = 0.0) -> None:
        """Judge a state, or what is wrong with it, ``passed`` [s] after the last one on a simulated plant's clock."""
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
        # If the distance of all joints is below the limit, so is that of every joint. A value that is not a number is
        # far.
        far = not math.dist(q, last_q) < _JUMP_ALLOWANCE
        if far and (fault := self._jump(q, last_q, max(now - last.stamp, passed, 0.0))):
            self._fail(fault)
        elif not _all_within(q, self._still_at, _REST):
            self._still_since, self._still_at = now, q

    def lose(self, why: Reason) -> None:
        """Arms cannot be commanded, although they are measured."""
        believed = self.believed
        self._fail(why)
        self._lost = believed

    @property
    def believed(self) -> bool:
        """Whether arms may brake by the newest state, also while there is a fault."""
        return self.fault is None or self._lost

    def settled(self, now: float) -> bool:
        """Whether states have been good and at rest for the settle time."""
        fresh = now - self._stamp <= self._settings.timeout
        return fresh and now - self._still_since >= self._settings.settle_time

    def check(self, now: float) -> Reason | None:
        """The fault of now, or None."""
        if self.fault is not None:
            return self.fault
        # A clock that was set back would let lost states look fresh for as long.
        timeout, age = self._settings.timeout, now - self._stamp
        if not -timeout <= age <= timeout:
            self._fail(Reason.of(ReasonKind.STATES_SILENT, age=age, timeout=timeout, source=self._source()))
        return self.fault

    def deviates(self, reference: Array, now: float) -> Reason | None:
        """A reason where the arms have been too far from ``reference`` for too long, else None."""
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
            ReasonKind.OFF_REFERENCE,
            joint=self._names[worst],
            deviation=float(deviation[worst]),
            time=now - self._near_at,
            allowed=allowed,
            allowed_time=self._settings.deviation_time,
        )

    def accept(self) -> None:
        """Believe from now on what :meth:`settled` found good."""
        self.fault, self._near_at, self._lost = None, None, False

    def accept_at_once(self, state: RobotState, now: float) -> None:
        """Believe ``state`` without waiting: the arms are known to be at rest there."""
        self.state, self._q = state, state.q.tolist()
        self._still_since, self._still_at = now, self._q
        self.accept()

    @property
    def _stamp(self) -> float:
        return -math.inf if self.state is None else self.state.stamp

    def _unusable(self, state: RobotState, external: Array) -> Reason | None:
        kind, bridged = ReasonKind.STATE_NOT_FINITE, 1e3 * self._settings.unusable_time
        for what, values in (("position", state.q), ("velocity", state.v), ("external torque", external)):
            for name, value in zip(self._names, values, strict=True):
                if not math.isfinite(value):
                    return Reason.of(kind, quantity=what, joint=name, value=str(value), bridged=bridged)
        return None

    def _jump(self, q: list[float], last: list[float], time: float) -> Reason | None:
        """The fault of a joint that moved farther than it can in ``time`` [s], else None."""
        moved = np.abs(np.subtract(q, last))
        reach = self._velocity_limit * (time + _JUMP_TIME) + _JUMP_ALLOWANCE
        if not (moved > reach).any():
            return None
        worst = int((moved - reach).argmax())
        return Reason.of(ReasonKind.STATE_JUMPED, joint=self._names[worst], distance=float(moved[worst]))

    def _fail(self, fault: Reason) -> None:
        self._still_since, self._lost = math.inf, False
        # The first fault tells most; before the first good state the newest does.
        if self.fault is None or self.state is None:
            self.fault = fault


def _all_within(q: list[float], other: list[float], limit: float) -> bool:
    """Whether no value is farther from the other than ``limit``; not where one is not a number."""
    distance = math.dist(q, other)
    return distance < limit or (math.isfinite(distance) and max(map(abs, map(sub, q, other))) <= limit)


_SLOW = 0.01  # a held arm's joints are slower before its tool's pose is taken [rad/s]
# How fast the reference's elbows follow the measured ones [1/s], [rad/s].
_FOLLOW = {"posture_gain": 10.0, "posture_speed": 1.5}


@dataclass(slots=True)
class ExternalSettings:
    """The limits for arms that another controller moves; may be changed at run time."""

    tolerance: float = 0.01  # measured pairs may be closer by this than they are kept apart [m]


def settings_for_external_arms(config: Config) -> Config:
    """The cell's configuration with elbows that are free to follow, and with the deviation for arms that lag.

    The lag is the other controller's. Arms that come too close are found in what is measured, at any deviation.
    """
    control = config.control.model_copy(update=_FOLLOW)
    stiff = config.admittance.model_copy(update={"enabled": False})  # compliance is the other controller's
    supervision = config.supervision
    lagging = supervision.model_copy(update={"max_deviation": supervision.max_deviation_external})
    return config.model_copy(update={"control": control, "admittance": stiff, "supervision": lagging})


class ExternalArms:
    """The targets of the controller, and the checks, for arms that another controller moves after its reference.

    The reference keeps the arms apart only as far as the arms are where it is. For that reason its elbows follow the
    measured ones, and held tools keep their pose instead of joint positions. Measured pairs may not be closer than the
    reference's may, less a tolerance for the lag of an arm.
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
        self._near_at: dict[str, float] = {}  # when an arm's tool was last seen near [s]
        self._held: dict[str, pin.SE3] = {}

    def begin(self) -> None:
        self._held.clear()
        self._near_at.clear()

    def targets(self, wanted: dict[str, pin.SE3 | None], last: Reference | None) -> dict[str, pin.SE3 | None]:
        """The same targets with the tool's own pose for each arm that has none and rests in the ``last`` reference."""
        for arm, pose in wanted.items():
            if pose is not None:
                self._held.pop(arm, None)
            elif arm not in self._held and (last is None or np.abs(last.v[self._robot.arms[arm].joints]).max() < _SLOW):
                self._held[arm] = self._controller.tool_pose(arm)
        return {arm: self._held.get(arm, pose) for arm, pose in wanted.items()}

    def left_behind(self, state: RobotState, holding: Iterable[str], now: float) -> Reason | None:
        """A reason where the tool of a ``holding`` arm has been away from its reference's for too long, else None.

        Nothing moves that arm, and it could not be engaged: a stream has to begin where tool and reference both are.
        """
        holding = set(holding)
        for arm in self._robot.arms:
            tool, led = self._robot.tool_pose(state.q, arm), self._controller.tool_pose(arm)
            way, turn = apart(tool, led)
            near = way <= self._streams.engage_distance and turn <= self._streams.engage_angle
            if near or arm not in holding or arm not in self._near_at:
                self._near_at[arm] = now
            elif now - self._near_at[arm] > self._watch.deviation_time:
                return Reason.of(ReasonKind.LEFT_BEHIND, arm=arm, distance=way, angle=turn)
        return None

    def too_close(self, state: RobotState) -> Reason | None:
        """A reason where a measured pair is closer than allowed, else None."""
        distances, kept = self._robot.distance_values(state.q), self._controller.kept_distances
        if (distances - kept).min(initial=np.inf) >= -self._settings.tolerance:
            return None
        tightest = int(np.argmin(distances - kept))
        least, tolerance = kept[tightest], self._settings.tolerance
        return Reason.of(
            ReasonKind.TOO_CLOSE,
            pair="|".join(pair_names(self._robot.collision_model)[tightest]),
            distance=float(distances[tightest]),
            allowed=float(least - tolerance),
            key=self._keys[tightest],
            kept=float(least),
            tolerance=tolerance,
        )
