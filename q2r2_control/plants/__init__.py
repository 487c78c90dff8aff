"""What moves. To add a plant, implement ``Plant`` of ``base``, which also checks commands.

``factory`` makes a plant by name. ``kinematic`` follows commands exactly. ``mujoco`` simulates the
cell: ``mujoco_model``, ``mujoco_obstacles`` and ``scene`` build it, ``servo`` drives its joints, ``mujoco_view`` shows
it, and ``mujoco_cameras`` takes the pictures of its own cameras. ``follower`` and ``simulated_cell`` run it from
commands that come at any time, as from ROS. MuJoCo is imported only where it is used.
"""
