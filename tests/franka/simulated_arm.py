"""Serve one simulated FR3 by franka-sim, which runs in an environment of its own: it needs older packages than ours.

    python simulated_arm.py 127.0.0.11 build/fr3.xml

A line on standard input changes what the robot does: ``user stop``, ``user stop ends`` or ``reflex``. The robot ends at
the end of standard input. It prints ``ready`` when it listens.
"""

from __future__ import annotations

import os
import sys
import threading
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
from franka_sim import FrankaSimServer

# Rotor inertia [kg m^2] and dry friction [Nm] of the joints, as the FR3 of MuJoCo Menagerie (franka_fr3/fr3.xml) has
# them. The URDF of franka-sim has neither.
ARMATURE = (0.195, 0.195, 0.195, 0.195, 0.074, 0.074, 0.074)
FRICTION = (1.137, 1.137, 1.137, 1.137, 0.763, 0.44, 0.248)
REFLEX = 3  # The number of a measured joint velocity above its limit, one of the errors that end in a reflex.


def write_model(path: Path) -> None:
    """Write the MuJoCo model of franka-sim's URDF, so that nothing has to be downloaded. It has no meshes."""
    urdf = ElementTree.fromstring(FrankaSimServer.DEFAULT_ARM_URDF.read_text())
    for link in urdf.iter("link"):
        for kind in ("visual", "collision"):
            for shape in link.findall(kind):
                link.remove(shape)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(urdf, encoding="unicode"))
    for joint, armature, friction in zip(spec.joints, ARMATURE, FRICTION, strict=True):
        joint.armature, joint.frictionloss, joint.damping = armature, friction, 0.21
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.compile()
    path.write_text(spec.to_xml())


def obey(server: FrankaSimServer) -> None:
    for line in sys.stdin:
        asked = line.strip()
        if asked == "reflex":
            server._abort_with_error(REFLEX, "asked for by a test", server.current_motion_id)
    server.stop()
    os._exit(0)


def main(host: str, model: str) -> None:
    write_model(Path(model))
    os.environ["FR3_MJCF"] = model
    server = FrankaSimServer(host=host, enforce_comm_constraints=True, enforce_motion_limits=True)
    threading.Thread(target=obey, args=(server,), daemon=True).start()
    print("ready", flush=True)
    server.start()


if __name__ == "__main__":
    main(*sys.argv[1:])
