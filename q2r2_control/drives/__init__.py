"""Ways to drive a plant: what becomes of a reference before it is sent, the same for every loop.

``position`` sends the reference itself, or its velocity; ``torque`` sends the torques of an impedance about it. The
pipeline hands the commands to a plant, the ROS nodes turn them into messages. What stops the arms is not decided here
but in ``supervision``.
"""
