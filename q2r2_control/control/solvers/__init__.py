"""Solvers of the QP by name. DAQP and OSQP are called directly, and all others through qpsolvers.

``registry`` finds the solver of a name. ``guard`` stands before every solver except DAQP. It passes copies to the
solver, and turns every answer that is not a solution into a failed solve. The certified stop is executed then.
"""
