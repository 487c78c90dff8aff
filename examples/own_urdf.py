"""Your own URDF: an arm of six joints, described here, under the same controller."""

import numpy as np
import pinocchio as pin

from q2r2_control import CartesianController, ControllerSettings, Robot

AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
LENGTH = 0.2  # of each link [m]


def link(name: str) -> str:
    """A capsule-like cylinder along z, with a mass."""
    return (
        f'<link name="{name}"><inertial><mass value="1"/><origin xyz="0 0 {LENGTH / 2}"/>'
        '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
        f'<collision><origin xyz="0 0 {LENGTH / 2}"/><geometry><cylinder radius="0.03" length="0.14"/></geometry>'
        "</collision></link>"
    )


def joint(number: int, axis: str) -> str:
    """A joint with the limits that the controller keeps."""
    return (
        f'<joint name="joint_{number}" type="revolute"><parent link="link_{number - 1}"/><child link="link_{number}"/>'
        f'<origin xyz="0 0 {LENGTH}"/><axis xyz="{axis}"/>'
        '<limit lower="-2" upper="2" velocity="2" effort="50"/></joint>'
    )


joints = "".join(joint(number, axis) for number, axis in enumerate(AXES, 1))
urdf = f'<robot name="mine">{"".join(link(f"link_{number}") for number in range(7))}{joints}</robot>'

robot = Robot.from_urdf(urdf, arms={"left": "link_6"})
controller = CartesianController(robot, ControllerSettings())
controller.reset(np.array([0.0, 0.5, 1.0, 0.0, 0.5, 0.0]))
goal = controller.tool_pose("left") * pin.SE3(np.eye(3), np.array([0.05, 0.05, 0.0]))
for _ in range(2000):
    reference = controller.step({"left": goal}, 0.001)
error = np.linalg.norm(controller.tool_pose("left").translation - goal.translation)
print(f"{robot.name}: {len(robot.joint_names)} joints, tool {1e3 * error:.2f} mm from its target")
