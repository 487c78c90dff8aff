"""What people see of a run or a headset. All of it listens; nothing waits for it, and none of it needs ROS.

``live`` is the table of a run, which ``drawing`` draws in a thread of its own, ``history`` what ``report`` draws plots
from, ``topic_table`` and ``headset_table`` show what a headset sends.
"""
