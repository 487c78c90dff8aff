"""The functions that keep every limit and every distance, whatever targets and solver do. README.md has the argument.

``joint_limits`` bounds the next velocities. ``stop_certificate`` proves that a step and the stop after it are safe. The
proof uses the bound of ``speed_bound``, or ``separating_plane`` if distances are too small for that bound.
``safety_filter`` executes as much of the solver's solution as can be certified. ``separation_rows`` are not needed for
safety: with them, the solver seldom asks for motion that cannot be certified. Each function takes a ``SafetyModel``
(constant within a tick) and ``SafetyData`` (the reference's state, and results that are written at each tick).
"""
