"""Between ROS and the package's own data: messages in and out, and whether those on the other side can be relied on.

``messages`` and ``joint_messages`` convert, with ``serialized`` where the same names come again and again; ``frames``
says where a tool is, ``link_frames`` where links are; ``intakes`` takes targets and joint states; ``joint_outputs``
sends joint commands; ``target_output`` and ``arm_outputs`` send tool poses to a controller, which ``home_client`` asks
for the way home; ``arm_pair`` is what one arm's node has in common with the other's, ``arm_feedback`` what the operator
is told, ``controller_feedback`` what the built-in controller tells; ``grippers`` commands grippers, as far as
``opening_grants`` is told by the controller, where ``gripper_limits`` decides; ``hand_topics``, ``hand_intake``,
``arm_conditions``, ``markers`` and ``distance_marker`` do one kind of topic each, ``reports`` does what is for a
recorder; ``parameters`` reads parameters, and ``live_parameters`` takes those that change. The modules are imported
when their names are first used.
"""
