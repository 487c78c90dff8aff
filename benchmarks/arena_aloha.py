"""gym-aloha's cube transfer, for the arena: the right arm gives a cube to the left one.

Its own way is that of its authors: a mocap body pulls each hand through a simulation of its own, in which the arms have
no motors, and the joint positions found there are played to the position actuators of the task. This is open loop.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping

os.environ.setdefault("MUJOCO_GL", "disabled")  # no pictures are taken

import mujoco
import numpy as np
import pinocchio as pin
from dm_control.mujoco import Physics
from gym_aloha.constants import ASSETS_DIR, DT, START_ARM_POSE, unnormalize_puppet_gripper_position
from gym_aloha.tasks import sim
from gym_aloha.utils import sample_box_pose

from arena_hands import Ask, Judge, ScriptedHands, shifted
from arena_robot import ArmModel, robot_of, tool_pose
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.types import SIDES, Array

TASK = "TransferCube"
OURS, MOCAP = "q2r2", "mocap, played"
CONTROLLERS = (OURS, MOCAP)
_TICKS = 10  # of our controller in a period
_SETTINGS = ControllerSettings(min_distance=0.003)  # both hands hold a cube of 40 mm
_JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
_VELOCITY = np.pi  # of every joint in its maker's description, of which this model says nothing [rad/s]
_MEETING = np.array([0.0, 0.5, 0.25])
_ARMS = {
    side: ArmModel(
        base=f"vx300s_{side}",
        joints=tuple(f"vx300s_{side}/{joint}" for joint in _JOINTS),
        velocity_limit=np.full(len(_JOINTS), _VELOCITY),
        tool=f"cali_{side}_site1",  # between the tips of the fingers
    )
    for side in SIDES
}


class AlohaCell:
    """The task with one of the controllers, an episode at a time."""

    PERIOD = DT

    def __init__(self, controller: str) -> None:
        self._kind = controller
        self._physics = Physics.from_xml_path(str(ASSETS_DIR / "bimanual_viperx_transfer_cube.xml"))
        self._task = sim.TransferCubeTask()
        self.arms = _ARMS
        self.model, self._data = self._physics.model.ptr, self._physics.data.ptr
        self._steps = round(DT / self.model.opt.timestep)
        self._follower: CartesianController | None = None
        self._played: Iterator[Array] = iter(())

    def reset(self, seed: int) -> None:
        """Begin another episode."""
        sim.BOX_POSE[0] = sample_box_pose(seed)
        self._task.initialize_episode(self._physics)
        self._physics.forward()
        self.judge = Judge(self.model, self.arms)
        if self._kind == MOCAP:
            self._played = iter(_rehearsed(seed))
        elif self._follower is None:
            self._follower = CartesianController(robot_of(self.model, self.arms, _closing(self._data.qpos)), _SETTINGS)
        if self._follower is not None:
            self._follower.reset(self._follower.robot.home)

    def tools(self) -> dict[str, pin.SE3]:
        return {side: tool_pose(self._data, arm) for side, arm in self.arms.items()}

    def succeeded(self) -> bool:
        """By the task's own reward: the left gripper touches the cube, which is off the table."""
        return bool(self._task.get_reward(self._physics) == self._task.max_reward)

    def step(self, before: Mapping[str, pin.SE3], targets: Mapping[str, pin.SE3], closed: tuple[str, ...]) -> None:
        """One period, in which the hands go from ``before`` to ``targets``."""
        if self._follower is None:
            action = next(self._played, None)
            if action is None:
                return
        else:
            for tick in range(_TICKS):
                share = (tick + 1) / _TICKS
                on_the_way = {side: pin.SE3.Interpolate(before[side], targets[side], share) for side in self.arms}
                q = self._follower.step(on_the_way, DT / _TICKS).q
            arms = self._follower.robot.arms
            action = np.concatenate([np.append(q[arms[side].joints], float(side not in closed)) for side in SIDES])
        self._task.before_step(action, self._physics)
        for _ in range(self._steps):
            self._physics.step()
            self.judge.look(self._data)

    def asks(self) -> Iterator[Ask]:
        """What the hands ask for; poses are read off the simulation when they are due."""
        return _transfer(self._data)


def _transfer(data: mujoco.MjData) -> Iterator[Ask]:
    start = {side: tool_pose(data, arm) for side, arm in _ARMS.items()}
    cube = data.body("box").xpos.copy()
    # Tools look along x, and close along y: the right one leans down to pick, the left one has turned by 90 degrees.
    down = pin.SE3(pin.exp3(np.array([0.0, 0.0, np.pi])) @ pin.exp3(np.array([0.0, np.pi / 3, 0.0])), cube)
    level = {
        "right": pin.SE3(pin.exp3(np.array([0.0, 0.0, np.pi])), _MEETING),
        "left": pin.SE3(pin.exp3(np.array([np.pi / 2, 0.0, 0.0])), _MEETING),
    }
    yield Ask({"right": shifted(down, z=0.1), "left": start["left"]})
    yield Ask({"right": down})
    yield Ask({"right": down}, closed=("right",), pause=0.6)
    yield Ask({"right": level["right"], "left": shifted(level["left"], x=-0.12)}, closed=("right",), pause=0.6)
    middle = data.body("box").xpos.copy()
    take = pin.SE3(level["left"].rotation, middle - [0.01, 0.0, 0.0])
    yield Ask({"left": take}, closed=("right",), pause=0.4)
    yield Ask({"left": take}, closed=("left", "right"), pause=0.6)
    yield Ask({}, closed=("left",), pause=0.5)
    yield Ask({"right": shifted(level["right"], x=0.12)}, closed=("left",), pause=0.5)


def _rehearsed(seed: int) -> list[Array]:
    """Actions of an episode: the positions of joints whose hands a mocap body pulls along the same targets."""
    physics = Physics.from_xml_path(str(ASSETS_DIR / "bimanual_viperx_end_effector_transfer_cube.xml"))
    model, data = physics.model.ptr, physics.data.ptr
    with physics.reset_context():
        data.qpos[:16] = START_ARM_POSE
        data.qpos[16:23] = sample_box_pose(seed)
        mujoco.mj_kinematics(model, data)
        for number, side in enumerate(SIDES):
            hand = data.body(f"vx300s_{side}/gripper_link")
            data.mocap_pos[number], data.mocap_quat[number] = hand.xpos, hand.xquat
    tools = {side: tool_pose(data, arm) for side, arm in _ARMS.items()}
    hands = ScriptedHands(_transfer(data), tools)
    shift = {
        side: tools[side].actInv(pin.SE3(body.xmat.reshape(3, 3), body.xpos))
        for side, body in ((side, data.body(f"vx300s_{side}/gripper_link")) for side in SIDES)
    }
    actions: list[Array] = []
    while not hands.done and len(actions) * DT < 20.0:
        hands.advance({side: tool_pose(data, arm) for side, arm in _ARMS.items()}, DT)
        for number, side in enumerate(SIDES):
            pulled = hands.targets[side] * shift[side]
            data.mocap_pos[number] = pulled.translation
            quaternion = pin.Quaternion(pulled.rotation).coeffs()
            data.mocap_quat[number] = quaternion[[3, 0, 1, 2]]
            finger = unnormalize_puppet_gripper_position(float(side not in hands.closed))
            data.ctrl[2 * number : 2 * number + 2] = finger, -finger
        physics.step(round(DT / model.opt.timestep))
        open_ = [float(side not in hands.closed) for side in SIDES]
        actions.append(np.concatenate([np.append(data.qpos[8 * k : 8 * k + 6], open_[k]) for k in range(2)]))
    return actions


def _closing(q: Array) -> list[Array]:
    """Positions of the whole cell with grippers from open to closed."""
    found = []
    for finger in (0.057, 0.045, 0.033, 0.021):
        found.append(q.copy())
        found[-1][[6, 14]], found[-1][[7, 15]] = finger, -finger
    return found
