"""The rules that stop an arm or keep it from starting. The pipeline and the ROS nodes share them.

``supervisor`` decides at every tick which targets the controller gets and whether the arms may move. ``joint_watch``
judges the measured states. ``targets`` and ``target_stream`` decide which sender the arms follow. ``homing`` moves the
arms without targets. ``tick_pacer`` judges late ticks, and limits targets for controllers without limits of their own.
This package imports no ROS and reads no clock: every function gets the time as an argument.
"""
