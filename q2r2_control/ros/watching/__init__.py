"""Watching a set of nodes from outside, for ``q2r2 ros watch`` and ``q2r2 ros doctor``: nothing here takes part in it.

``set_view`` says what is known of a set, and why an arm does not move; ``set_listener`` finds that out in the running
domain; ``findings`` says what is wrong with it, and ``environment`` what of ROS is missing here. They are imported when
first used; only ``set_listener`` needs rclpy.
"""
