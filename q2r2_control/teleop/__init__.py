"""Turn the samples of one operator's hands into target poses for the tools.

``teleop`` is the entry point: its update runs once per tick for all arms. ``both_arms`` carries out the actions that
concern both arms, and ``arm`` the actions of one arm. ``arm_states`` has the table of state transitions. ``gate``,
``gestures`` and ``filters`` turn samples into poses and presses. ``hand_motion`` computes the targets: ``relative``
maps the motion of a hand to one tool, ``carry`` maps it to two tools, and ``leash`` keeps a target near its tool.
``haptics`` makes the hands vibrate. ``policy_side`` lets a policy drive arms that no hand drives; ``policy_motion``
puts its actions on one time line.
"""
