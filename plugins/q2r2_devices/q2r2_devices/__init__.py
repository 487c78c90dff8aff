"""Inputs without a headset: SpaceMice, and all teleoperators of lerobot. Each input is found by its entry point.

``reading`` reads a device in a thread. ``rate`` integrates velocities to the pose of a hand. ``spacemouse`` has the
reports of a SpaceMouse and its input. ``teleoperators`` has the input for lerobot, ``leader`` the kinematics of a
leader arm, and ``pedal`` the pedal that engages it.
"""
