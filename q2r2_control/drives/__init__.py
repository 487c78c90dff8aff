"""Turn the controller's reference into commands of a plant, by position, velocity or torque.

The pipeline hands these commands to a plant, and the ROS nodes turn them into messages. The rules that stop the arms
are in ``supervision``.
"""
