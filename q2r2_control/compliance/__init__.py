"""Let arms yield to a push.

In torque mode, the torques with which arms yield are computed after the QP is solved. In position mode, targets are
displaced before the QP is built.

``impedance`` turns the QP's reference into torques with which each tool acts as a damped spring; ``impedance_law`` has
the equations. ``repulsion`` adds a repulsive force between measured links. For arms that take positions, ``admittance``
displaces the targets according to the measured wrench.
"""
