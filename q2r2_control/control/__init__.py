"""Turn targets of the tools into joint motion that keeps every limit and keeps the arms apart.

``controller`` is the entry. ``targets`` checks the targets, and ``qp`` builds the QP from ``tasks`` and solves it.
``reference`` moves the reference as far as ``safety`` allows. ``watched_pairs`` holds the distances that pairs keep,
and the bodies that change between steps. ``kernel_model`` holds the data of the compiled kernels, and ``jit`` compiles
them. ``tasks`` and ``safety`` import ``geometry``, and neither imports the other.
"""
