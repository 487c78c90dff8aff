"""Ways to drive a plant: what becomes of a reference before it is sent, the same for every loop.

The pipeline hands the commands to a plant, the ROS nodes turn them into messages. The rules that stop the arms are in
``supervision``.
"""
