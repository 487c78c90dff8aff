"""Hostile streams of targets, which are random but the same for the same seed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control.benchmark.work_motions import ARMS, WORK_MOTIONS
from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.pairs import CLEARANCE
from q2r2_control.robot.robot import Robot
from q2r2_control.types import ALL_OF_THE_WAY, Array, Interval


class Request(NamedTuple):
    """The targets of one tick."""

    targets: dict[str, Any]
    unusable: frozenset[str] = frozenset()  # Arms whose target has to be reported as rejected.


# A function of the tick within the segment and of the last reference's joint positions (nv,), which returns a request.
Stream = Callable[[int, Array], Request]
_TABLE = 0.2  # Height of the table's top, on which tools press, as in the shipped cells [m].
_TICK = 0.001  # In each tick, a work motion at its usual speed goes on by this time [s].
# A gain changes to its value at the start, times one of these factors. With a smaller separation gain, the arms would
# be slow long before contact, which would test little.
_GAIN_SHARES = {
    **dict.fromkeys(("position_gain", "rotation_gain", "posture_gain", "max_linear_speed"), (0.1, 1.0, 2.0)),
    **{"separation_gain": (0.5, 1.0, 4.0), "stretch_gain": (0.1, 1.0, 10.0), "posture_weight": (0.1, 1.0, 100.0)},
}
_WORKSPACE = np.array([[-0.6, -1.1, -0.1], [1.1, 1.1, 1.4]])  # Lower and upper corner of a box for random poses [m].


class Adversary:
    """Makes random streams of targets for the arms of one robot. There is a method for each name in :attr:`names`."""

    names = (
        *("hold", "stay_home", "teleport", "crossing", "same_point", "unreachable", "into_the_table", "random_walk"),
        *("garbage", "missing_arms", "elbow", "chatter", "shaking", "postures", "work", "pressing"),
    )

    def __init__(self, robot: Robot, random: np.random.Generator) -> None:
        self._robot, self._random = robot, random
        self._arms = tuple(robot.arms)
        self._others = {arm: self._arms[i - 1] for i, arm in enumerate(self._arms)}
        self._home = {arm: robot.tool_pose(robot.home, arm) for arm in self._arms}
        self._data = robot.model.createData()

    def stream(self, name: str) -> Stream:
        """Return a new stream of targets of the kind ``name``."""
        made: Stream = getattr(self, f"_{name}")()
        return made

    def pose(self) -> pin.SE3:
        """Return a random tool pose (world frame) anywhere around the cell."""
        return pin.SE3(pin.exp3(self._random.normal(size=3) * 1.5), self._random.uniform(*_WORKSPACE))

    def _constant(self, targets: dict[str, Any]) -> Stream:
        request = Request(targets)
        return lambda tick, q: request

    def _poses(self) -> dict[str, Any]:
        return {arm: self.pose() for arm in self._arms}

    def _moved(self, by: Callable[[], Array]) -> dict[str, Any]:
        return {arm: pin.SE3(pose.rotation, pose.translation + by()) for arm, pose in self._home.items()}

    def _hold(self) -> Stream:
        return self._constant({})

    def _stay_home(self) -> Stream:
        return self._constant(dict(self._home))

    def _teleport(self) -> Stream:
        """Return a stream in which each tool gets a new random pose at regular intervals."""
        return self._renewed(int(self._random.integers(5, 800)), self._poses)

    def _postures(self) -> Stream:
        """Return a stream of tool poses that belong to random postures with many joints at their limits."""

        def poses() -> dict[str, Any]:
            q = self._random.uniform(self._robot.position_lower, self._robot.position_upper)
            at_limit = self._random.random(len(q)) < 0.3
            q[at_limit] = np.where(q > 0.0, self._robot.position_upper, self._robot.position_lower)[at_limit]
            return {arm: self._robot.tool_pose(q, arm) for arm in self._arms}

        return self._renewed(int(self._random.integers(100, 1500)), poses)

    def _renewed(self, period: int, poses: Callable[[], dict[str, Any]]) -> Stream:
        request = Request({})

        def stream(tick: int, q: Array) -> Request:
            nonlocal request
            if tick % period == 0:
                request = Request(poses())
            return request

        return stream

    def _crossing(self) -> Stream:
        """Return a stream that sends each tool to the pose that another tool has at home."""
        return self._constant({arm: self._home[self._others[arm]] for arm in self._arms})

    def _same_point(self) -> Stream:
        place = self._random.uniform([0.2, -0.5, 0.3], [0.8, 0.5, 1.0])
        return self._constant({arm: pin.SE3(pose.rotation, place) for arm, pose in self._home.items()})

    def _unreachable(self) -> Stream:
        """Return a stream of targets that are out of reach: a few metres to 1e200 m away."""
        size = 10.0 ** self._random.uniform(0.3, 200.0 if self._random.random() < 0.2 else 2.0)
        return self._constant(self._moved(lambda: self._random.normal(size=3) * size))

    def _into_the_table(self) -> Stream:
        depth = self._random.uniform(0.1, 1.0)
        return self._constant(self._moved(lambda: np.array([*self._random.uniform(-0.3, 0.3, size=2), -depth])))

    def _random_walk(self) -> Stream:
        """Return a stream of random walks, which are faster than an arm can move, and which tend back towards home."""
        speed, turn = self._random.uniform(0.001, 0.05), self._random.uniform(0.0, 0.1)
        poses = {arm: pose.copy() for arm, pose in self._home.items()}

        def stream(tick: int, q: Array) -> Request:
            for arm, pose in poses.items():
                back = 0.002 * (self._home[arm].translation - pose.translation)
                rotation = pin.exp3(turn * self._random.normal(size=3)) @ pose.rotation
                poses[arm] = pin.SE3(rotation, pose.translation + back + speed * self._random.normal(size=3))
            return Request(dict(poses))

        return stream

    def _garbage(self) -> Stream:
        """Return a stream of unusable targets for some arms, and of targets for an arm that does not exist."""

        def stream(tick: int, q: Array) -> Request:
            targets: dict[str, Any] = self._poses()
            unusable = set()
            for arm in (*self._arms, "nobody"):
                if self._random.random() < 0.5:
                    targets[arm] = self._unusable()
                    unusable.add(arm)
            return Request(targets, frozenset(unusable))

        return stream

    def _unusable(self) -> Any:
        kind = int(self._random.integers(7))
        pose = self.pose()
        if kind == 0:
            pose.translation = np.full(3, np.nan)
        elif kind == 1:
            pose.translation = np.array([np.inf, 0.0, -np.inf])
        elif kind == 2:
            pose.rotation = pose.rotation * float(self._random.choice([0.0, 0.5, -1.0, 1e150, np.inf, np.nan]))
        elif kind == 3:
            pose.rotation = np.diag([1.0, 1.0, -1.0])
        elif kind == 4:
            pose.rotation = self._random.normal(size=(3, 3)) + 3.0 * np.eye(3)
        else:
            return ("here", np.eye(4))[kind - 5]
        return pose

    def _missing_arms(self) -> Stream:
        """Return a stream in which each arm has a target in some ticks and none in others."""
        poses = self._poses()

        def stream(tick: int, q: Array) -> Request:
            present = {arm: pose for arm, pose in poses.items() if self._random.random() < 0.7}
            return Request(present | {arm: None for arm in self._arms if self._random.random() < 0.2})

        return stream

    def _elbow(self) -> Stream:
        """Return a stream in which one tool chases the elbow or wrist of another arm, which has a random target."""
        chaser = str(self._random.choice(self._arms))
        joint = int(self._robot.arms[self._others[chaser]].joints[3 if self._random.random() < 0.5 else 5]) + 1
        request = Request({})
        elsewhere = self._poses()

        def stream(tick: int, q: Array) -> Request:
            nonlocal request
            if tick % 10 == 0:
                pin.forwardKinematics(self._robot.model, self._data, q)
                there = pin.SE3(self._home[chaser].rotation, self._data.oMi[joint].translation.copy())
                request = Request(elsewhere | {chaser: there})
            return request

        return stream

    def _chatter(self) -> Stream:
        """Return a stream of targets that jump between two poses at every tick."""
        pair = [Request(self._poses()) for _ in range(2)]
        return lambda tick, q: pair[tick % 2]

    def _shaking(self) -> Stream:
        """Return a stream of oscillating targets, which may be faster than the tool's limit.

        The targets move mainly along y, towards the other arm.
        """
        size, rate = self._random.uniform(0.05, 0.6), self._random.uniform(0.005, 0.1)
        along = self._random.normal(size=3) * [0.3, 1.0, 0.3]

        def stream(tick: int, q: Array) -> Request:
            by = size * np.sin(rate * tick) * along
            return Request(self._moved(lambda: by))

        return stream

    def _work(self) -> Stream:
        """Return a stream that plays a work motion of two arms, from a random time on, at up to three times its speed.

        Robots with other arms get the stream "shaking".
        """
        if self._arms != ARMS:
            return self._shaking()
        motion = tuple(WORK_MOTIONS.values())[int(self._random.integers(len(WORK_MOTIONS)))]
        begins, speed = self._random.uniform(0.0, motion.rests), self._random.uniform(0.3, 3.0) * _TICK
        return lambda tick, q: Request(dict(motion.targets(begins + speed * tick, self._home)))

    def _pressing(self) -> Stream:
        """Return a stream that presses the tools onto the table, or against each other, and lets them slide."""
        down, rate = self._random.random() < 0.5, self._random.uniform(0.001, 0.02)
        place, depth = self._random.uniform([0.3, -0.2, 0.3], [0.7, 0.2, 0.6]), self._random.uniform(0.0, 0.1)

        def stream(tick: int, q: Array) -> Request:
            slide = 0.1 * np.array([np.sin(rate * tick), np.cos(0.7 * rate * tick), 0.0])
            poses: dict[str, Any] = {}
            for arm, pose in self._home.items():
                goal = [*pose.translation[:2], _TABLE - depth] if down else place
                poses[arm] = pin.SE3(pose.rotation, np.array(goal) + slide)
            return Request(poses)

        return stream


class HostileChanges:
    """Makes random changes during motion: openings of grippers, grasps, and settings. None means no change."""

    def __init__(self, controller: CartesianController, seed: int) -> None:
        self._settings = controller.settings
        self._arms, self._with_object = tuple(controller.robot.arms), tuple(controller.robot.objects.by_arm)
        self._openings, self._grasps, self._changes = (np.random.default_rng([seed, stream]) for stream in (3, 4, 5))

    def opening(self) -> tuple[str, Interval] | None:
        """Return a random arm and a random interval of its gripper's opening, or None for no change."""
        random = self._openings
        if random.random() > 0.05:
            return None
        arm, kind = str(random.choice(self._arms)), int(random.integers(4))
        first, second = np.sort(random.random(2)).tolist()
        return arm, (ALL_OF_THE_WAY, (0.0, 0.0), (first, second), (0.0, second))[kind]

    def grasp(self) -> tuple[str, bool] | None:
        """Return a random arm, and whether it holds its object from this tick on, or None for no change.

        Arms can move at any speed when their grasp changes, and changes follow each other after random times.
        """
        if not self._with_object or self._grasps.random() > 0.02:
            return None
        return str(self._grasps.choice(self._with_object)), bool(self._grasps.random() < 0.7)

    def settings(self) -> dict[str, float] | None:
        """Return the name and the new value of one setting, a distance or a gain; None for no change."""
        random = self._changes
        if random.random() > 0.01:
            return None
        if random.random() < 0.7:
            return {"min_distance": float(random.choice([0.0, self._settings.min_distance, CLEARANCE]))}
        name = str(random.choice(list(_GAIN_SHARES)))
        return {name: float(random.choice(_GAIN_SHARES[name])) * float(getattr(self._settings, name))}
