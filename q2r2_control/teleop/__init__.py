"""From hand samples to tool targets: what one operator's hands ask the arms to do.

``teleop`` drives all arms, ``both_arms`` does what is for both and ``arm`` what is for one, by the table of
``arm_states``. ``hand_motion`` makes targets of a hand's poses: ``relative`` maps its motion to that of the tool,
``carry`` to that of two, ``leash`` keeps a target near its tool, and ``steady_state_offset`` its command
where it was. ``gate``, ``gestures`` and ``filters`` turn samples into poses and presses; ``haptics`` makes the hands
vibrate.
"""
