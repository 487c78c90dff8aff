"""Turn targets of the tools into joint motion that keeps every limit and keeps the arms apart.

Begin with ``controller``. ``targets`` checks the targets, and ``qp`` builds the QP of a step from ``tasks``.
``reference`` moves the reference as far as ``safety`` allows. ``watched_pairs`` holds the distances that pairs keep,
and the bodies that change between steps. ``kernel_model`` holds the data of the compiled kernels, and ``jit`` compiles
them. ``tasks`` and ``safety`` import ``geometry``, and neither imports the other.
"""
