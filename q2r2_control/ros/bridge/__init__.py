"""Between ROS and the package's own data: messages in, messages out, nothing decided.

``messages`` converts; ``frames`` says where a tool is; ``intakes`` takes targets and joint states; ``outputs``,
``torque_outputs`` and ``make_output`` send joint commands; ``target_output`` and ``arm_outputs`` send tool poses to a
controller; ``grippers``, ``hand_topics`` and ``markers`` do one kind of topic each; ``parameters`` reads parameters.
Nothing is imported here: all of it needs rclpy.
"""
