"""The rules that stop an arm or keep one from starting, the same for the pipeline and the ROS nodes.

``supervisor`` decides at every tick which targets the controller gets and whether the arms may move. ``joint_watch``
judges measured states, ``targets`` and ``target_stream`` who is followed. ``homing`` moves arms without targets.
``tick_pacer`` judges late ticks, and limits targets for controllers that have no limits. No ROS and no clock in here.
"""
