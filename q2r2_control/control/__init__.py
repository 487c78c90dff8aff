"""Tool targets in, joint motion out that keeps every limit and keeps the arms apart.

``controller`` is the way in; ``targets`` checks what is asked, ``qp_assembly`` builds the QP from ``tasks``, ``qp``
solves it where ``unconstrained`` has not, ``reference`` moves the reference as far as ``safety`` lets it.
``kernel_model`` and ``kernel_data`` are what the compiled kernels read and write; ``jit`` compiles them, ``cholesky``
factors matrices for them. ``tasks`` and ``safety`` import ``geometry`` and not each other.
"""
