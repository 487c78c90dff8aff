"""Your own URDF, which describes an arm of six joints for the same controller."""

import numpy as np
import pinocchio as pin

from q2r2_control import CartesianController, ControllerSettings, Robot

# Each link is 0.2 m long along its z axis. The next joint is at its end and turns about one of AXES.
LINK = """<link name="link_{0}">
  <inertial><mass value="1"/><origin xyz="0 0 0.1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0 0 0.1"/><geometry><cylinder radius="0.03" length="0.14"/></geometry></collision>
</link>"""
JOINT = """<joint name="joint_{1}" type="revolute">
  <parent link="link_{0}"/><child link="link_{1}"/><origin xyz="0 0 0.2"/><axis xyz="{2}"/>
  <limit lower="-2" upper="2" velocity="2" effort="50"/>
</joint>"""
AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")

links = [LINK.format(number) for number in range(7)]
joints = [JOINT.format(number, number + 1, axis) for number, axis in enumerate(AXES)]
urdf = f'<robot name="mine">{"".join(links + joints)}</robot>'

robot = Robot.from_urdf(urdf, arms={"left": "link_6"})
controller = CartesianController(robot, ControllerSettings())
controller.reset(np.array([0.0, 0.5, 1.0, 0.0, 0.5, 0.0]))
goal = controller.tool_pose("left") * pin.SE3(np.eye(3), np.array([0.05, 0.05, 0.0]))
for _ in range(2000):
    reference = controller.step({"left": goal}, 0.001)
error = np.linalg.norm(controller.tool_pose("left").translation - goal.translation)
print(f"{robot.name}: {len(robot.joint_names)} joints, tool {1e3 * error:.2f} mm from its target")
