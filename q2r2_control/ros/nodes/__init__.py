"""The nodes, one module for each executable, of the same name where the language allows it.

``base_arm_controller`` teleoperates one arm and is what a robot's own arms are derived from, as ``left_arm_controller``
and ``right_arm_controller`` are, and ``arm_controllers`` is both in one process; ``cartesian_controller`` is the built-
in controller; ``mujoco_robot`` is the simulated robot; ``tcp_endpoint`` serves the headset; ``simulation_input``
(SimulationInput) replaces it by a script; ``recorder`` keeps what they publish; ``check_tcp_connection``
(CheckTCPconnection) shows what arrives. A node is imported when its name is first used.
"""
