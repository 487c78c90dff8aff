"""What a node knows about other nodes, so that it can stop in time and name the one that is missing.

``endpoints`` says which nodes publish on a topic and whether listeners still acknowledge; ``arm_link`` connects the
nodes of the two arms, so that a fault of one pauses the other; ``hand_listeners`` says of a hand's topics which arms
follow them; ``frame_senders`` whether two publish the same frame on /tf; ``command_watch`` whether another node sends
a node's own joint commands. They are imported when first used.
"""
