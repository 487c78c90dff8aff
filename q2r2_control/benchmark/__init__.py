"""Figures of this machine: control ticks beside public peers, work motions, a whole loop, latencies through ROS nodes.

``tick_times`` times our controller and the ``peers`` in turns, by runs of ``timed_run``. ``work_bench`` asks them for
two-armed work, one motion and one controller at a time by ``motion_run``, which tests can use alone. ``stack_bench``
runs the same motions from hand samples to arms in MuJoCo, by ``stack_run``. ``loop_times`` tells where a tick of the
live loop goes, by ``stage_clock``, and ``feel_run`` what an operator feels of a filter. ``command_responses`` finds the
commands that answer steps of an input, ``press_times`` what follows a press; ``ros_latency`` and ``ros_press``, which
need ROS, record them. ``press_run`` presses a finger on the table, and ``sliding_stability`` tells from which
friction on such a slide chatters by itself. ``rest_run`` asks for places that the arms get in each other's way at.
"""
