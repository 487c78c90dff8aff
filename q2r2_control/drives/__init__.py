"""Turn the controller's reference into commands for a plant: positions, velocities or torques.

The pipeline hands these commands to a plant, and the ROS nodes turn them into messages. The rules that stop the arms
are in ``supervision``.
"""
