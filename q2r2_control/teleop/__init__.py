"""From hand samples to tool targets: what one operator's hands ask the arms to do.

``teleop`` drives all arms, ``both_arms`` does what is for both and ``arm`` what is for one, by the table of
``arm_states``. ``gate``, ``gestures`` and ``filters`` turn samples into poses and presses. ``hand_motion`` makes
targets: ``relative`` maps a hand's motion to that of the tool, ``carry`` to that of two, and ``leash`` keeps a target
near its tool. ``haptics`` makes the hands vibrate. ``policy_side`` lets a policy drive arms that no hand drives, by the
time line that ``policy_motion`` makes of its actions.
"""
