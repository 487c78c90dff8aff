"""Let arms yield to a push: in torque mode by terms after the QP, in position mode by targets before the QP.

``impedance`` turns the QP's reference into torques with which each tool acts as a damped spring; ``impedance_law`` has
the equations. ``repulsion`` adds a repulsive force between measured links. For arms that take positions, ``admittance``
displaces the targets according to the measured wrench.
"""
