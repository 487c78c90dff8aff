"""The arena's cell for robosuite's two-arm tasks, with robosuite's model of the IIWA."""

from __future__ import annotations

import copy
import logging
from collections.abc import Iterator, Mapping

import mujoco
import numpy as np
import pinocchio as pin
import robosuite

from arena_hands import Ask, Judge, backed, looking_down, shifted
from arena_robot import ArmModel, robot_of, tool_pose
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

TASKS = ("TwoArmLift", "TwoArmHandover")
OURS, OSC = "q2r2", "OSC_POSE"
CONTROLLERS = (OURS, OSC)
PERIOD = 0.05  # Period of the hands' targets, which is robosuite's default period of an action [s].
# Number of ticks of our controller in one period. Each tick commands robosuite's joint position controller.
_TICKS_PER_PERIOD = 5
_SETTINGS = ControllerSettings(min_distance=0.003)
# The joints are stiff enough to follow the reference. They are critically damped, with a time constant of 1/60 s.
_JOINT_CONTROL = {
    "type": "JOINT_POSITION",
    "input_type": "absolute",
    "kp": 3600,
    "damping_ratio": 1,
    "interpolation": None,
}
_JOINT_CONTROL |= {"input_max": 7, "input_min": -7, "output_max": 7, "output_min": -7, "ramp_ratio": 0.2}
_MEETING_PLACE = np.array([0.0, -0.15, 1.12])  # Position at which the right hand takes the hammer, in the world [m].
_MIN_GRASP_Y = -0.5  # Least y at which the left hand can grasp while it points down [m].
_RIGHT_HAND_LEAN = 0.9  # Angle by which the right hand leans towards its own base [rad].
_CLOSING_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)  # Positions of the fingers, from open (0) to closed (1).

logging.getLogger("robosuite_logs").setLevel(logging.ERROR)


class RobosuiteCell:
    """One of robosuite's tasks, and the controller of its arms. The cell plays one episode after the other."""

    PERIOD = PERIOD

    def __init__(self, task: str, controller: str) -> None:
        self._task, self._kind = task, controller
        self._follower: CartesianController | None = None
        # These are KUKA's limits, because robosuite's model has no velocity limits.
        limits = Robot.from_config(load_config("config/iiwa7.yaml")).velocity_limit
        self.arms = {side: _arm_model(number, limits) for number, side in enumerate(("left", "right"))}

    def reset(self, seed: int) -> None:
        """Begin another episode."""
        config = robosuite.load_composite_controller_config(robot="IIWA")
        if self._kind == OURS:
            config["body_parts"]["right"] = {**_JOINT_CONTROL, "gripper": config["body_parts"]["right"]["gripper"]}
        self._env = robosuite.make(
            self._task,
            robots=["IIWA", "IIWA"],
            controller_configs=[config, copy.deepcopy(config)],
            has_renderer=False,
            has_offscreen_renderer=False,
            use_camera_obs=False,
            use_object_obs=False,
            control_freq=round((_TICKS_PER_PERIOD if self._kind == OURS else 1) / PERIOD),
            ignore_done=True,
            seed=seed,
        )
        self._env.sim.forward()  # This updates the poses of objects that robosuite placed after its own update.
        self.model, self._data = self._env.sim.model._model, self._env.sim.data._data
        self.judge = Judge(self.model, self.arms)
        step = self._env.sim.step2

        def watched() -> None:
            step()
            self.judge.look(self._data)

        self._env.sim.step2 = watched
        if self._kind == OURS:
            if self._follower is None:
                robot = robot_of(self.model, self.arms, _closing(self.model, self._data.qpos, self.arms))
                self._follower = CartesianController(robot, _SETTINGS)
            names = self._follower.robot.joint_names
            self._follower.reset(np.array([self._data.joint(name).qpos[0] for name in names]))

    def tools(self) -> dict[str, pin.SE3]:
        return {side: tool_pose(self._data, arm) for side, arm in self.arms.items()}

    def succeeded(self) -> bool:
        """Return whether the environment's own judge sees a success."""
        return bool(self._env._check_success())

    def step(self, before: Mapping[str, pin.SE3], targets: Mapping[str, pin.SE3], closed: tuple[str, ...]) -> None:
        """Simulate one period, in which the hands move from ``before`` to ``targets``."""
        grip = {side: 1.0 if side in closed else -1.0 for side in self.arms}
        if self._follower is None:
            tools = self.tools()
            action = [np.append(self._delta(side, tools[side], targets[side]), grip[side]) for side in self.arms]
            self._env.step(np.concatenate(action))
            return
        for tick in range(_TICKS_PER_PERIOD):
            share = (tick + 1) / _TICKS_PER_PERIOD
            on_the_way = {side: pin.SE3.Interpolate(before[side], targets[side], share) for side in self.arms}
            q = self._follower.step(on_the_way, PERIOD / _TICKS_PER_PERIOD).q
            # An action that is not 0 moves the gripper by one step. With one such action in each period, the gripper
            # is as fast as with the other controllers.
            action = [
                np.append(q[self._follower.robot.arms[side].joints], grip[side] * (tick == 0)) for side in self.arms
            ]
            self._env.step(np.concatenate(action))

    def _delta(self, side: str, tool: pin.SE3, target: pin.SE3) -> Array:
        """Return the action (6,) with which robosuite's controller OSC moves a tool to ``target``.

        The first three numbers are steps along the axes of the arm's base frame, divided by the largest step (0.05 m).
        The last three numbers are turns about these axes, divided by the largest turn (0.5 rad).
        """
        way, turn = target.translation - tool.translation, pin.log3(target.rotation @ tool.rotation.T)
        base = self._env.robots[list(self.arms).index(side)].base_ori
        return np.clip(np.concatenate([base.T @ way / 0.05, base.T @ turn / 0.5]), -1.0, 1.0)

    def asks(self) -> Iterator[Ask]:
        """Yield the target poses and gripper states of the hands. Each item is computed when the hands need it."""
        return self._lift() if self._task == "TwoArmLift" else self._handover()

    def _lift(self) -> Iterator[Ask]:
        """Let each hand grasp a handle from above, across its width, and lift it."""
        tools = self.tools()
        yield Ask({side: shifted(tool, z=0.13) for side, tool in tools.items()})
        pot = self._data.body("pot_root").xmat.reshape(3, 3)
        grasps = {}
        for number, (side, tool) in enumerate(tools.items()):
            closing = pot[:, 0] * np.sign(pot[:, 0] @ tool.rotation[:, 0])
            grasps[side] = pin.SE3(looking_down(closing), self._data.site(f"pot_handle{number}").xpos.copy())
        yield Ask({side: shifted(grasp, z=0.13) for side, grasp in grasps.items()})
        yield Ask(grasps)
        yield Ask(grasps, closed=("left", "right"), pause=0.8)
        yield Ask({side: shifted(grasp, z=0.2) for side, grasp in grasps.items()}, closed=("left", "right"), pause=1.0)

    def _handover(self) -> Iterator[Ask]:
        """Let the left hand grasp the hammer's handle at one end and bring it. The right hand takes the other end."""
        tools, handle = self.tools(), self._data.geom("hammer_handle")
        half = float(self.model.geom("hammer_handle").size[2]) - 0.02  # Half of the distance between the grasps [m].
        axis = _towards_right(handle.xmat)
        closing = np.cross(axis, [0.0, 0.0, 1.0])
        closing *= np.sign(closing @ tools["left"].rotation[:, 0])
        # Distance from the handle's middle to the left grasp [m]. With this distance, the grasp is at y >=
        # _MIN_GRASP_Y, because the left hand cannot point down nearer to its base.
        way = min(half, max((handle.xpos[1] - _MIN_GRASP_Y) / max(axis[1], 1e-6), 0.0))
        grasp = pin.SE3(looking_down(closing), handle.xpos - way * axis)
        brought = pin.SE3(looking_down(np.array([np.sign(closing[0]) or 1.0, 0.0])), _MEETING_PLACE - [0.0, way, 0.0])
        facing = float(np.sign(tools["right"].rotation[0, 0]))
        ready = pin.SE3(looking_down(np.array([facing, 0.0])), _MEETING_PLACE)
        yield Ask({"left": shifted(grasp, z=0.12), "right": shifted(ready, y=0.3, z=0.15)})
        yield Ask({"left": grasp})
        yield Ask({"left": grasp}, closed=("left",), pause=0.8)
        yield Ask({"left": shifted(grasp, z=0.15)}, closed=("left",))
        yield Ask({"left": brought}, closed=("left",), pause=0.5)
        place = handle.xpos + half * _towards_right(handle.xmat)
        take = pin.SE3(looking_down(ready.rotation[:, 0], -_RIGHT_HAND_LEAN * facing), place)
        yield Ask({"right": backed(take, 0.12)}, closed=("left",))
        yield Ask({"right": take}, closed=("left",))
        yield Ask({"right": take}, closed=("left", "right"), pause=0.8)
        yield Ask({}, closed=("right",), pause=0.8)
        yield Ask({"left": backed(brought, 0.15)}, closed=("right",), pause=0.5)


def _towards_right(rotation: Array) -> Array:
    """Return the axis (3,) of the hammer's handle, in the direction towards the right arm."""
    axis = rotation.reshape(3, 3)[:, 2]
    return axis * (np.sign(axis[1]) or 1.0)


def _arm_model(number: int, velocity_limit: Array) -> ArmModel:
    return ArmModel(
        base=f"robot{number}_base",
        joints=tuple(f"robot{number}_joint_{joint}" for joint in range(1, 8)),
        velocity_limit=velocity_limit,
        tool=f"gripper{number}_right_grip_site",
    )


def _closing(model: mujoco.MjModel, q: Array, arms: Mapping[str, ArmModel]) -> list[Array]:
    """Return positions (nq,) of the whole cell, for each of :data:`_CLOSING_SHARES` of the grippers.

    The actuators move the fingers to these positions in a simulation without contacts.
    """
    held = [int(model.joint(name).qposadr[0]) for arm in arms.values() for name in arm.joints]
    scratch, found = mujoco.MjData(model), []
    flags, model.opt.disableflags = model.opt.disableflags, model.opt.disableflags | mujoco.mjtDisableBit.mjDSBL_CONTACT
    scratch.qpos[:] = q
    for opening in _CLOSING_SHARES:
        for actuator in range(model.nu):
            if "finger" in model.actuator(actuator).name:
                least, greatest = model.actuator_ctrlrange[actuator]
                closes = opening if least == 0.0 else 1.0 - opening
                scratch.ctrl[actuator] = least + closes * (greatest - least)
        for _ in range(500):
            mujoco.mj_step(model, scratch)
            scratch.qpos[held], scratch.qvel[:] = q[held], 0.8 * scratch.qvel
        found.append(scratch.qpos.copy())
    model.opt.disableflags = flags
    return found
