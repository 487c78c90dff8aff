"""The nodes, one module for each executable, of the same name where the language allows it.

``base_arm_controller`` teleoperates one arm and is what a robot's own arms are derived from, as ``left_arm_controller``
and ``right_arm_controller`` are; ``cartesian_controller`` is the built-in controller; ``mujoco_robot`` is the simulated
robot; ``tcp_endpoint`` serves the headset; ``simulation_input`` (SimulationInput) replaces it by a script;
``check_tcp_connection`` (CheckTCPconnection) shows what arrives. Nothing is imported here: each needs rclpy.
"""
