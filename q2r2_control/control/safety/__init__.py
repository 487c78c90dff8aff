"""The functions that keep every limit and every distance, whatever targets and solver do; the argument is in README.md.

``joint_limits`` bounds the next velocities. ``stop_certificate`` proves a step and the stop after it, by
``speed_bound`` or, where distances leave no room for that, ``separating_plane``. ``safety_filter`` takes the part of a
solution that can be certified. ``separation_rows`` are for comfort: they make the solver ask for little else. Each
takes a ``SafetyModel`` (fixed) and ``SafetyData`` (the reference's state, and what is rewritten at each tick).
"""
