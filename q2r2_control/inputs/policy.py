"""An input whose data are the actions of a policy. The actions have the same form as in a dataset.

An action has the same numbers as a feature of datasets, in the same order; see :class:`ActionSpace`. The thread that
sends actions also checks them, and converts joint positions to tool poses. The teleop layer follows these poses as it
follows a hand.
"""

from __future__ import annotations

import importlib
import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from types import NoneType

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.errors import CameraError, ConfigError, check_kind, shown
from q2r2_control.events import CommonReason, Reason
from q2r2_control.inputs.base import Input, make_input
from q2r2_control.inputs.policy_checks import PolicyErrors, UnusableError, check_finite, check_names, numbers_of
from q2r2_control.robot.robot import Robot
from q2r2_control.types import POSE_FIELDS, QUEST_CONTROLS, ActionChunk, Array, HandSample, HapticFeedback, Observation

MOTION_FIELDS = ("x", "y", "z", "rx", "ry", "rz")
_GAPS = 0.002, 0.5  # Least and greatest time from one action to the next [s].
_MOST = 1000  # Greatest number of actions in one chunk.
_NO_OPERATOR = replace(QUEST_CONTROLS, words=replace(QUEST_CONTROLS.words, nobody="a policy moves the arms"))
_KEPT = 20  # Number of chunks that are kept between two ticks. If more come, the newest ones are kept.
_JOINED = 1.0  # Longest time that the end of a run waits for a policy that still computes [s].


class ActionSpace(StrEnum):
    """The kind of numbers in an action. Each value is the name of the dataset feature that has the same numbers.

    After these numbers, an action may contain the openings of all grippers.
    """

    JOINTS = "action"  # Joint positions of all arms [rad].
    TOOL = "action.tool"  # Tool poses x y z [m] qx qy qz qw in the world frame.
    # Motions from each target pose to the next: displacement [m] and rotation vector [rad], in the first pose's axes.
    TOOL_DELTA = "action.tool_delta"


def action_names(robot: Robot, space: ActionSpace) -> tuple[str, ...]:
    """Return the names of an action's numbers in their order, as datasets have them.

    Args:
        robot: The robot that the action moves.
        space: The space of the action.

    Returns:
        The joints' names for ``ActionSpace.JOINTS``; otherwise names such as ``left_x``, arm by arm. Openings of
        grippers, which may follow as ``left_gripper`` and ``right_gripper``, are not among them.
    """
    if space is ActionSpace.JOINTS:
        return tuple(robot.joint_names)
    fields = POSE_FIELDS if space is ActionSpace.TOOL else MOTION_FIELDS
    return tuple(f"{arm}_{number}" for arm in robot.arms for number in fields)


Policy = Callable[[Observation], npt.ArrayLike]


class PolicyInput:
    """Moves the arms by actions of :meth:`send`, and lets a hand take over. Implements :class:`PolicySource`.

    Args:
        policy: A function of an :class:`Observation` that returns the next actions, (n, size) or (size,). The first
            action is for the observation's time. The function runs in a thread of its own, and is called again when
            half of its actions are over. In simulated time, the loop waits for its result. Without a policy, a program
            calls :meth:`send` itself, from any thread.
        space: The space of the actions; None for the policy's attribute ``space``, or joints if it has none.
        rate: The rate of the actions [Hz]; None for the policy's attribute ``rate``, or 30 Hz if it has none.
        operator: An input whose hands take over arms. A press takes over an arm, and the next press gives it back to
            the policy.

    Raises:
        ConfigError: If the space, the rate, the policy or the operator is not allowed.
    """

    options = ("policy", "takeover", "fast", "say")
    simulated = True  # With an operator, simulated time is possible only if the operator's input is simulated too.

    def __init__(
        self,
        policy: Policy | None = None,
        *,
        space: ActionSpace | str | None = None,
        rate: float | None = None,
        operator: Input | None = None,
    ) -> None:
        space = getattr(policy, "space", ActionSpace.JOINTS) if space is None else space
        rate = getattr(policy, "rate", 30.0) if rate is None else rate
        if not isinstance(space, str) or space not in list(ActionSpace):
            raise ConfigError(f"space = {shown(space)}: allowed: {', '.join(ActionSpace)}")
        if not (isinstance(rate, float | int) and _GAPS[0] <= 1.0 / max(rate, 1e-9) <= _GAPS[1]):
            raise ConfigError(f"rate = {shown(rate)}: allowed: {1.0 / _GAPS[1]:g} to {1.0 / _GAPS[0]:g} Hz")
        if policy is not None and not callable(policy):
            raise ConfigError(f"policy = {shown(policy)}: allowed: a function of an Observation, or None")
        check_kind("operator", operator, (Input, NoneType), "an object with all methods of Input, or None")
        self.space, self.period, self._policy, self.operator = ActionSpace(space), 1.0 / float(rate), policy, operator
        self.controls = _NO_OPERATOR if operator is None else operator.controls
        self.observation: Observation | None = None  # The newest observation.
        self._chunks: deque[ActionChunk] = deque(maxlen=_KEPT)
        self._wake, self._ends = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._robot: Robot | None = None
        self._realtime, self._started = True, False
        self._due = -np.inf  # The policy is called again for the first observation from this time on [s].
        self._errors = PolicyErrors()

    @classmethod
    def from_config(
        cls,
        config: Config,
        policy: str | None = None,
        takeover: str | None = None,
        *,
        named: str = "--policy",
        **options: object,
    ) -> PolicyInput:
        """Make an input.

        Args:
            config: The cell.
            policy: A policy or its class, as "module:name".
            takeover: The name of the input whose hands may take over; None for no operator.
            named: The words with which errors about the policy begin.
            options: Keyword arguments for the input ``takeover``.
        """
        if policy is None:
            raise ConfigError("input policy: --policy MODULE:NAME is missing, which names the policy")
        operator = None if takeover is None else make_input(takeover, config, **options)
        return cls(_loaded(policy, named), operator=operator)

    @property
    def connected(self) -> bool:
        return self._started if self.operator is None else self.operator.connected

    @property
    def feels(self) -> bool:
        """True if there is an operator, whose device may vibrate."""
        return self.operator is not None

    def prepare(self, robot: Robot, realtime: bool) -> None:
        """See :class:`PolicySource`."""
        self._robot, self._realtime = robot, realtime
        self._due, self.observation = -np.inf, None
        self._chunks.clear()

    def start(self) -> None:
        if self.operator is not None:
            self.operator.start()
        self._started = True
        self._ends.clear()
        if self._policy is not None and self._realtime:
            self._thread = threading.Thread(target=self._run, name="policy", daemon=True)
            self._thread.start()

    def poll(self, now: float) -> list[HandSample]:
        return [] if self.operator is None else self.operator.poll(now)

    def chunks(self) -> list[ActionChunk]:
        """See :class:`PolicySource`."""
        return [self._chunks.popleft() for _ in range(len(self._chunks))]

    def observe(self, observation: Observation) -> None:
        """See :class:`PolicySource`."""
        check_kind("observation", observation, Observation, "an Observation")
        self.observation = observation
        if not self._realtime:
            self._ask()
        elif observation.time >= self._due:
            self._wake.set()

    def send_haptic(self, feedback: HapticFeedback) -> None:
        if self.operator is not None:
            self.operator.send_haptic(feedback)

    def close(self) -> None:
        self._started = False
        self._ends.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join(_JOINED)
            self._thread = None
        if self.operator is not None:
            self.operator.close()

    def send(self, actions: npt.ArrayLike, times: npt.ArrayLike | None = None, names: Sequence[str] = ()) -> None:
        """Send actions (n, size), or one action (size,). From the first action's time on, they replace earlier actions.

        The method never raises. Actions that cannot be used stop the arms, with a reason that the run shows.

        Args:
            actions: The numbers of the actions.
            times: The time of each action (n,), on the loop's clock [s]. Without ``times``, the first action has the
                time of the newest observation, and the others follow at the rate.
            names: The names of an action's numbers, to be checked. Without ``names``, only the length of an action
                is checked.
        """
        try:
            chunk = self._checked(actions, times, names)
        except UnusableError as error:
            chunk = self._fault(str(error))
        self._chunks.append(chunk)

    def _run(self) -> None:
        while not self._ends.is_set():
            self._wake.wait()
            self._wake.clear()
            if not self._ends.is_set():
                self._ask()

    def _ask(self) -> None:
        observation = self.observation
        if self._policy is None or observation is None or observation.time < self._due:
            return
        count = 1
        try:
            answer = self._policy(observation)
            if answer is None:
                raise UnusableError("the policy returned None; allowed: an array of actions (n, size)")
            actions = np.atleast_2d(numbers_of("actions", answer))
            count = len(actions)
            self.send(actions, observation.time + self.period * np.arange(count))
        except (UnusableError, CameraError) as error:
            self._chunks.append(self._fault(str(error)))
        except BaseException as error:  # The loop goes on after any error of a policy.
            if not isinstance(error, Exception) and threading.current_thread() is threading.main_thread():
                raise  # The exception comes from a signal handler, and ends the program.
            self._errors.show(error)
            self._chunks.append(self._fault(f"the policy raised {type(error).__name__}: {error}".removesuffix(": ")))
        self._due = observation.time + max(count // 2, 1) * self.period - 1e-9

    def _fault(self, text: str) -> ActionChunk:
        reason = Reason.of(CommonReason.POLICY_UNUSABLE, text=" ".join(text.split())[:200])
        return ActionChunk(np.zeros(0), self.period, fault=reason)

    def _checked(self, actions: npt.ArrayLike, times: npt.ArrayLike | None, names: Sequence[str]) -> ActionChunk:
        robot = self._robot
        if robot is None:
            raise UnusableError("sent before the run began")
        values = np.atleast_2d(numbers_of("actions", actions))
        expected = action_names(robot, self.space)
        grippers = tuple(f"{arm}_gripper" for arm in robot.arms)
        if not isinstance(names, list | tuple):
            raise UnusableError(f"names = {shown(names)}; allowed: a list of names")
        allowed = tuple(names) if names else (*expected, *grippers)[: values.shape[-1]]
        check_names(allowed, expected, grippers)
        size = len(allowed)
        if values.ndim == 2 and not 0 < len(values) <= _MOST:
            raise UnusableError(f"{len(values)} actions in one answer; allowed: 1 to {_MOST}")
        if values.ndim != 2 or values.shape[1] != size:
            sizes = f"{len(expected)} or {len(expected) + len(grippers)}"
            raise UnusableError(f"actions have the shape {values.shape}; allowed: (n, {size if names else sizes})")
        check_finite(values, allowed)
        stamps = self._stamps(times, len(values))
        period = (stamps[-1] - stamps[0]) / (len(stamps) - 1) if len(stamps) > 1 else self.period
        openings = {
            arm: np.clip(values[:, allowed.index(name)], 0.0, 1.0)
            for arm, name in zip(robot.arms, grippers, strict=True)
            if name in allowed
        }
        moved = values[:, : len(expected)]
        if self.space is ActionSpace.JOINTS:
            return ActionChunk(stamps, period, tools=self._tools(moved), grippers=openings, postures=moved)
        parts = dict(zip(robot.arms, np.split(moved, len(robot.arms), axis=1), strict=True))
        if self.space is ActionSpace.TOOL_DELTA:
            return ActionChunk(stamps, period, motions=parts, grippers=openings)
        for arm, poses in parts.items():
            lengths = np.linalg.norm(poses[:, 3:], axis=1)
            if (wrong := np.flatnonzero((lengths < 0.5) | (lengths > 2.0))).size:
                where = f"action {wrong[0]}: the quaternion of {arm}"
                raise UnusableError(f"{where} has the length {lengths[wrong[0]]:.3g}; allowed: 1, or nearly so")
        return ActionChunk(stamps, period, tools=parts, grippers=openings)

    def _stamps(self, times: npt.ArrayLike | None, count: int) -> Array:
        if times is None:
            if self.observation is None:
                raise UnusableError("times are missing, and nothing was observed yet")
            return np.asarray(self.observation.time + self.period * np.arange(count))
        stamps = np.atleast_1d(numbers_of("times", times))
        if stamps.shape != (count,) or not np.isfinite(stamps).all():
            raise UnusableError(f"times = {shown(times)}; allowed: a finite number for each of {count} actions")
        gaps = np.diff(stamps)
        if ((gaps < _GAPS[0]) | (gaps > _GAPS[1])).any():
            raise UnusableError(f"times = {shown(times)}; allowed: ascending, {_GAPS[0]:g} to {_GAPS[1]:g} s apart")
        return stamps

    def _tools(self, postures: Array) -> dict[str, Array]:
        """Return the tool poses (n, 7) of each arm at joint positions (n, nv)."""
        robot = self._robot
        assert robot is not None
        data = robot.model.createData()  # Each call makes its own data, because any thread may call ``send``.
        tools = {arm: np.empty((len(postures), 7)) for arm in robot.arms}
        for index, q in enumerate(postures):
            pin.forwardKinematics(robot.model, data, q)
            for name, arm in robot.arms.items():
                pose = pin.updateFramePlacement(robot.model, data, arm.frame_id)
                tools[name][index] = pin.SE3ToXYZQUATtuple(pose)
        return tools


def _loaded(where: str, named: str) -> Policy:
    """Return the policy "module:name" of a module that is installed or in the working directory.

    Error messages begin with ``named``, such as the option that names the policy.

    Raises:
        ConfigError: If there is no such policy.
    """
    check_kind(named, where, str, "MODULE:NAME")
    module, _, name = where.partition(":")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        found = getattr(importlib.import_module(module), name)
        found = found() if isinstance(found, type) else found
    except ModuleNotFoundError as error:
        looked = f"modules are looked for in the working directory, {here}, and among installed packages"
        raise ConfigError(f"{named} {where}: {error}; {looked}") from error
    except Exception as error:  # The module may raise any error.
        raise ConfigError(f"{named} {where}: {type(error).__name__}: {error}"[:200]) from error
    if not callable(found):
        raise ConfigError(f"{named} {where}: allowed: MODULE:NAME of a function of an Observation, or a class of such")
    loaded: Policy = found
    return loaded
