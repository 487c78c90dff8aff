"""How an arm gives way to what pushes it, after the QP in torque mode and before it in position mode.

``impedance`` turns the QP's reference into torques that make each tool a damped spring, by ``impedance_law``.
``repulsion`` adds a wall between measured links. ``admittance`` displaces targets by the measured wrench, for arms that
take positions.
"""
