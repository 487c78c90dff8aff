"""The links of the simulated robot as transforms: each in its parent's frame, as robot_state_publisher sends them."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage

from q2r2_control.ros.bridge.serialized import MessageWriter


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
    """Transforms of some bodies, serialized again and again."""

    def __init__(self, model: Any, bodies: list[int]) -> None:
        self._bodies, self._parents = np.array(bodies, int), model.body_parentid[bodies]
        message = TFMessage()
        for body, parent in zip(bodies, self._parents, strict=True):
            transform = TransformStamped(child_frame_id=model.body(body).name)
            transform.header.frame_id = model.body(parent).name
            message.transforms.append(transform)
        self._writer = MessageWriter(message)

    def at(self, data: Any, t: float) -> bytes:
        """The message for a ``mujoco.MjData`` at ``t`` [s], for a publisher."""
        matrices = data.xmat[self._parents].reshape(-1, 3, 3)
        numbers = self._writer.numbers.reshape(-1, 7)
        numbers[:, :3] = np.einsum("nji,nj->ni", matrices, data.xpos[self._bodies] - data.xpos[self._parents])
        numbers[:, 3:] = _relative(data.xquat[self._parents], data.xquat[self._bodies])
        return self._writer.at(t)


def _relative(parent: Any, child: Any) -> Any:
    """Rotations of children in their parents: (n, 4) from w first, as in MuJoCo, to x y z w, as in messages."""
    w, v = parent[:, :1], -parent[:, 1:]
    child_w, child_v = child[:, :1], child[:, 1:]
    scalar = w * child_w - np.einsum("ni,ni->n", v, child_v)[:, None]
    return np.hstack((w * child_v + child_w * v + _cross(v, child_v), scalar))


def _cross(a: Any, b: Any) -> Any:
    """Cross products of rows (n, 3); NumPy's own takes ten times as long."""
    return a[:, (1, 2, 0)] * b[:, (2, 0, 1)] - a[:, (2, 0, 1)] * b[:, (1, 2, 0)]
