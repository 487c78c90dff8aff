"""The display of a run on a headset: states with their reasons, the robot, parts, targets, and the recording."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, cast

import numpy as np
import pinocchio as pin

from q2r2_control.device_words import DeviceWords
from q2r2_control.inputs.webxr.shown import Point, Seven, ShownArm, ShownPair, ShownScene, ShownState
from q2r2_control.summary.tick import Tick
from q2r2_control.types import ActiveLimit, Array
from q2r2_control.viewer.arm_words import Told
from q2r2_control.viewer.shown_robot import ShownRobot
from q2r2_control.viewer.state_colours import state_colour
from q2r2_control.viewer.tightest_pair import TightestPair

_DIGITS = 4  # Number of decimals to which metres and quaternions are rounded.


class ShownTick(NamedTuple):
    """The data of one tick that are shown. The process that sends the messages makes the sentences from them."""

    tick: Tick
    binding: tuple[ActiveLimit, ...]  # Limits that held a step back since the last shown tick.
    told: Mapping[str, Told]  # For each arm, the events that say why it is in its state.
    hands: Mapping[str, str]  # For each arm, the hand that drives it.
    moved: Array | None  # MuJoCo's positions (qpos) of everything that moves.
    recording: str


class RunDisplay:
    """Makes the messages of the display, in the process that sends them. This process reads the robot's URDF again."""

    def __init__(self, run: ShownRobot, model: pin.Model, pairs: pin.GeometryModel, parts: Mapping[str, int]) -> None:
        """Prepare the display.

        ``model`` is the controller's model, and ``pairs`` has its bodies and monitored pairs. ``parts`` is the result
        of :func:`places_of_parts`.
        """
        self._run, self._model, self._pairs, self._parts = run, model, pairs, parts
        # The texts contain names of controls in braces. The page knows the operator's device, and replaces the names by
        # the words for the device's controls.
        bound = {binding.control for binding in run.config.teleop.bindings.bound()}
        self._words = run.words(DeviceWords(nouns={control: f"{{{control}}}" for control in bound}))

    def scene(self) -> ShownScene:
        """Return the meshes, each in the frame of a joint, and the loose parts."""
        # The import is here, because it needs trimesh, which may be missing.
        from q2r2_control.viewer.joint_tree import JointTree, colour_of

        self._tree, self._tightest = JointTree(self._run), TightestPair(self._model, self._pairs)
        self._data = self._tree.model.createData()
        objects = self._run.config.mujoco.objects
        return {
            "name": self._run.config.name,
            "meshes": [
                {
                    "joint": joint,
                    "colour": colour,
                    "vertices": np.asarray(mesh.vertices).round(_DIGITS).ravel().tolist(),
                    "faces": np.asarray(mesh.faces).ravel().tolist(),
                }
                for joint, colour, mesh in self._tree.meshes()
            ],
            "hands": {arm: self._joints_of_tool(joints) for arm, joints in self._run.joints.items()},
            "parts": {
                name: {"size": cast(Point, tuple(objects[name].size)), "colour": colour_of(objects[name].colour)}
                for name in self._parts
            },
            "floor": self._run.config.floor or 0.0,
            "timeout": self._run.config.teleop.gate.timeout,
        }

    def _joints_of_tool(self, joints: Array) -> list[int]:
        """Return the index of an arm's last joint, and the indices of all joints behind it, such as finger joints."""
        model = self._tree.model
        return [int(joint) for joint in model.subtrees[model.getJointId(self._run.joint_names[joints[-1]])]]

    def message(self, shown: ShownTick) -> ShownState:
        """Return the message about one tick of the run."""
        tick, words = shown.tick, self._words
        words.told = shown.told
        pin.forwardKinematics(self._tree.model, self._data, self._tree.posture(tick.state.q, tick.grippers))
        arms: dict[str, ShownArm] = {
            arm: {
                "state": tick.states[arm],
                "why": words.why(tick, arm, shown.binding),
                "next": words.next_press(tick, arm),
                "colour": state_colour(tick.states[arm]),
                "hand": shown.hands[arm],
                "silent": words.is_silent(tick, arm),
                "tool": _rounded(tool),
                "target": None if (target := tick.targets[arm].pose) is None else _rounded(target),
            }
            for arm, tool in tick.tools.items()
        }
        joints = [_rounded(placement) for placement in self._data.oMi]
        parts = {} if shown.moved is None else {name: _part(shown.moved, at) for name, at in self._parts.items()}
        return {"arms": arms, "joints": joints, "parts": parts, "pair": self._pair(tick), "recording": shown.recording}

    def _pair(self, tick: Tick) -> ShownPair | None:
        report = tick.reference.report
        self._tightest.place(tick.reference.q)
        ends = self._tightest.ends(report)
        if ends is None:
            return None
        first, second = ends.round(_DIGITS).tolist()
        return {"ends": (tuple(first), tuple(second)), "margin": round(report.margin, _DIGITS)}


def _rounded(pose: pin.SE3) -> Seven:
    return cast(Seven, tuple(round(number, _DIGITS) for number in pin.SE3ToXYZQUATtuple(pose)))


def _part(moved: Array, at: int) -> Seven:
    """Return the pose of a part, with the quaternion in the order x y z w.

    The pose begins at the index ``at`` of MuJoCo's positions ``moved``, where the quaternion is in the order w x y z.
    """
    x, y, z, qw, qx, qy, qz = moved[at : at + 7].round(_DIGITS).tolist()
    return x, y, z, qx, qy, qz, qw
