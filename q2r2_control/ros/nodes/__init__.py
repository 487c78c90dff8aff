"""The nodes, which :mod:`q2r2_control.ros.launch.executables` runs.

``base_arm_controller`` teleoperates one arm and is what a robot's own arms are derived from, as those of
``arm_controllers`` are, which run apart or in one process. ``cartesian_controller`` is the built-in controller,
``mujoco_robot`` the simulated robot. ``tcp_endpoint`` serves the headset, ``simulation_input`` and ``hand_input`` take
its place. ``recorder`` keeps what all publish, and ``check_tcp_connection`` shows what arrives of hands.
"""
