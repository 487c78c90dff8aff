"""What a node knows about other nodes, so that it can stop in time and name the one that is missing.

``endpoints`` says which nodes publish on a topic and whether listeners still acknowledge; ``arm_link`` connects the
nodes of the two arms, so that a fault of one pauses the other. Nothing is imported here: both need rclpy.
"""
