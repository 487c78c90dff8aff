"""Let arms yield to a push, after the QP in torque mode and before the QP in position mode.

``impedance`` turns the QP's reference into torques that make each tool a damped spring, by the equations of
``impedance_law``. ``repulsion`` adds a wall between measured links. ``admittance`` displaces targets by the measured
wrench, for arms that take positions.
"""
