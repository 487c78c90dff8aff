"""Solvers of the QP by name, with one module for each: DAQP and OSQP called directly, all others through qpsolvers.

``registry`` finds the solver of a name. ``guard`` stands before every solver but DAQP: it hands out copies, and turns
whatever is not a solution into a failed solve, after which the certified stop is executed.
"""
