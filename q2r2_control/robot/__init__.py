"""Robots and cells: found, joined to one URDF, checked, and made a Pinocchio model with the pairs that are watched.

``description`` finds and parses a model (``packages``, ``xacro_model``), ``arm_chain`` finds an arm in it. What
``compose`` joins stands in ``cell_parts``, ``urdf_parts``, ``locking`` and ``floor``. ``robot`` is what the controller
sees, with the checked joints and the models of ``pinocchio_models``; ``enclose`` and ``pairs`` make its collision
pairs, ``reachability`` and ``model_srdf`` find those that can never meet, and ``stop_torque`` says what a full stop
asks of the joints. ``finger_bodies`` makes fingers all that they sweep, ``finger_openings`` knows what of that counts
at an opening of fingers that slide, ``turning_fingers`` of those that turn.
"""
