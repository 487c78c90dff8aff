"""Solvers of the QP by name. DAQP and OSQP are called directly, and all others through qpsolvers.

``registry`` finds a solver by its name. Every solver except DAQP is called through ``guard``, which passes copies to
the solver, and turns every answer that is not a solution into a failed solve. The certified stop is then executed.
"""
