"""Tool targets in, joint motion out that keeps every limit and keeps the arms apart.

``controller`` is the way in. ``targets`` checks the targets, ``qp`` builds the QP from ``tasks`` and solves it.
``reference`` moves the reference as far as ``safety`` lets it. ``watched_pairs`` has what pairs keep, and the bodies
that change between steps. ``kernel_model`` is what the compiled kernels read and write; ``jit`` compiles them.
``tasks`` and ``safety`` import ``geometry`` and not each other.
"""
