"""What stops an arm, and what keeps one from starting: the same rules for the pipeline and the ROS nodes.

``supervisor`` decides at every tick what the controller is asked for and whether the arms may move; ``joint_watch``
judges measured states, ``targets`` and ``target_stream`` who is followed, ``target_line`` where to, ``tick_clock`` when
a tick counts, ``tick_pacer`` what a late one may move, ``delay_watch`` and ``sequence_watch`` whether a message is of
the past, or of another sender. ``homing`` leads arms without targets, by ``joint_homing`` or ``tool_homing``;
``external_arms`` are those that another controller moves.
``preflight`` looks at a cell before it runs, and ``target_guard`` limits targets for controllers that have no limits of
their own. For loops that drive grippers, as the pipeline does, there are ``gripper_limiter`` and ``grasp_watch``. No
ROS and no clock in here.
"""
