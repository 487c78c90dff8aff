"""Serve one simulated FR3 by franka-sim. It runs in an environment of its own, because it needs older packages.

    python simulated_arm.py 127.0.0.11 build/fr3.xml 0 0 0 -1.57 0 1.57 0.785

The numbers are the posture in which the robot starts [rad]. A line on standard input changes what the robot does:
``reflex``, ``user stop`` or ``user stop ends``. The process ends at the end of standard input. Its standard output says
what the robot does.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
from franka_sim import FrankaSimServer, mujoco_franka_sim

# Rotor inertia [kg m^2] and dry friction [Nm] of the joints, as the FR3 of MuJoCo Menagerie (franka_fr3/fr3.xml) has
# them. The URDF of franka-sim has neither.
ARMATURE = (0.195, 0.195, 0.195, 0.195, 0.074, 0.074, 0.074)
FRICTION = (1.137, 1.137, 1.137, 1.137, 0.763, 0.44, 0.248)
OBJECT_WIDTH = 0.04  # Width of the object between the fingers of the hand [m].
IDLE, USER_STOPPED = 1, 5  # Modes of the robot.
REFLEX = 3  # The number of an error that ends in a reflex: a measured joint velocity is above its limit.


class PunctualServer(FrankaSimServer):
    """A robot that drops a command that comes after its millisecond, as the robot's control does.

    libfranka's documentation says so (docs/network_requirements.rst). By default, franka-sim uses such a command, and
    takes back the motion that it has made meanwhile.
    """

    def _absorb_within_motion_limits(self, command: object, *, fresh: bool) -> bool:
        return fresh and super()._absorb_within_motion_limits(command, fresh=fresh)


def write_model(urdf: Path, path: Path) -> None:
    """Write the MuJoCo model of franka-sim's URDF, so that nothing has to be downloaded. It has no meshes."""
    robot = ElementTree.fromstring(urdf.read_text())
    for link in robot.iter("link"):
        for kind in ("visual", "collision"):
            for shape in link.findall(kind):
                link.remove(shape)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(robot, encoding="unicode"))
    for joint, armature, friction in zip(spec.joints, ARMATURE, FRICTION, strict=True):
        joint.armature, joint.frictionloss, joint.damping = armature, friction, 0.21
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.compile()
    path.write_text(spec.to_xml())


def obey(server: FrankaSimServer) -> None:
    for line in sys.stdin:
        asked, state = line.strip(), server.robot_state.state
        if asked == "reflex":
            server._abort_with_error(REFLEX, "asked for by a test")
        elif asked == "user stop":
            server._abort_with_error(REFLEX, "user stop asked for by a test")
            state["robot_mode"] = USER_STOPPED
            state["errors"] = [False] * len(state["errors"])
        elif asked == "user stop ends":
            state["robot_mode"] = IDLE
        print(f"did: {asked}", flush=True)
    os._exit(0)


def main(host: str, model: str, *posture: str) -> None:
    mujoco_franka_sim.ARM_INITIAL_Q[:] = [float(angle) for angle in posture]
    write_model(FrankaSimServer.DEFAULT_ARM_URDF, Path(model))
    os.environ["FR3_MJCF"] = model
    server = PunctualServer(
        host=host, enforce_comm_constraints=True, enforce_motion_limits=True, gripper_object_width=OBJECT_WIDTH
    )
    threading.Thread(target=obey, args=(server,), daemon=True).start()
    server.start()


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(levelname)s %(message)s")
    main(*sys.argv[1:])
