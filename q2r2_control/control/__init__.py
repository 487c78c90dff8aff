"""Tool targets in, joint motion out that keeps every limit and keeps the arms apart.

``controller`` is the way in; ``targets`` checks what is asked, ``qp_assembly`` builds the QP from ``tasks``, ``qp``
solves it where ``unconstrained`` has not, ``reference`` moves the reference as far as ``safety`` lets it.
``kernel_model`` and ``kernel_data`` are what the compiled kernels read and write; ``jit`` compiles them, ``cholesky``
factors matrices for them. ``tasks`` and ``safety`` import ``geometry`` and not each other.
"""

from q2r2_control.control.controller import CartesianController
from q2r2_control.control.kernel_data import KernelData
from q2r2_control.control.kernel_model import KernelModel, kernel_model_of
from q2r2_control.control.qp import QpProblem, QpSolution, Solver, make_solver
from q2r2_control.control.targets import TargetTracker

__all__ = [
    "CartesianController",
    "KernelData",
    "KernelModel",
    "QpProblem",
    "QpSolution",
    "Solver",
    "TargetTracker",
    "kernel_model_of",
    "make_solver",
]
