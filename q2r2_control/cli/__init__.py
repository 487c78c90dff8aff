"""The ``q2r2`` command: ``app`` is the whole, in which every error ends in one line and exit code 2.

``run``, ``check``, ``recordings``, ``bench`` and ``ros`` have the subcommands; these share ``cell_run``,
``cell_report`` and ``output``.
"""
