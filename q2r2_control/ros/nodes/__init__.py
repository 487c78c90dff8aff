"""The nodes, run by :mod:`q2r2_control.ros.launch.executables`.

``base_arm_controller`` teleoperates one arm and is what a robot's own arms are derived from, as those of
``arm_controllers`` are, which run apart or in one process; ``cartesian_controller`` is the built-in controller; ``mujoco_robot`` is the simulated robot; ``tcp_endpoint`` serves the headset; ``simulation_input``
(SimulationInput) replaces it by a script; ``recorder`` keeps what they publish; ``check_tcp_connection``
(CheckTCPconnection) shows what arrives. A node is imported when its name is first used.
"""
