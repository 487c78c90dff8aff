"""The links of the simulated robot as transforms: each in its parent's frame, as robot_state_publisher sends them."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np
from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage

from q2r2_control.ros.bridge.messages import time_message


class LinkFrames:
    """Links on a joint in ``moving``, all others in ``fixed``: what is on /tf_static is sent once."""

    def __init__(self, model: Any, without: Collection[str]) -> None:
        """Of a ``mujoco.MjModel``; bodies named in ``without`` are no links."""
        links = [index for index in range(1, model.nbody) if model.body(index).name not in without]
        on_joint = [index for index in links if model.body_jntnum[index]]
        fixed = [index for index in links if not model.body_jntnum[index]]
        self.moving = _Transforms(model, on_joint)
        self.fixed = _Transforms(model, fixed)


class _Transforms:
    """Transforms of some bodies."""

    def __init__(self, model: Any, bodies: list[int]) -> None:
        self._bodies, self._parents = bodies, model.body_parentid[bodies].tolist()
        self._message = TFMessage()
        for body, parent in zip(bodies, self._parents, strict=True):
            transform = TransformStamped(child_frame_id=model.body(body).name)
            transform.header.frame_id = model.body(parent).name
            self._message.transforms.append(transform)

    def at(self, data: Any, t: float) -> TFMessage:
        """The message for a ``mujoco.MjData`` at ``t`` [s]; the same object each time."""
        stamp, inverse, position, quaternion = time_message(t), np.zeros(4), np.zeros(3), np.zeros(4)
        for transform, body, parent in zip(self._message.transforms, self._bodies, self._parents, strict=True):
            mujoco.mju_negQuat(inverse, data.xquat[parent])
            mujoco.mju_rotVecQuat(position, data.xpos[body] - data.xpos[parent], inverse)
            mujoco.mju_mulQuat(quaternion, inverse, data.xquat[body])
            transform.header.stamp = stamp
            p, o = transform.transform.translation, transform.transform.rotation
            p.x, p.y, p.z = position.tolist()
            o.w, o.x, o.y, o.z = quaternion.tolist()  # MuJoCo has w first
        return self._message
