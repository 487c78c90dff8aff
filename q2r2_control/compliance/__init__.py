"""How an arm gives way to what pushes it, after the QP in torque mode and before it in position mode.

``impedance`` turns the QP's reference into torques that make each tool a damped spring; ``repulsion`` adds a wall
between measured links; ``admittance`` displaces targets by the measured wrench, for arms that take positions. The
formulas stand in ``impedance_law`` and ``admittance_law``, the wall's compiled ones in ``repulsion_kernels``.
"""
