"""The ``q2r2`` command, of which ``app`` holds the whole and each other module of a command's name one subcommand.

``cell_run`` is a run as ``demo`` and ``run`` offer it, ``cell_report`` what ``check`` finds out. Shared are
``options``, ``output``, ``error_handling`` (every error in one line, exit code 2), ``headset_server``, ``tables`` and
``summary_table``. The entry point is ``q2r2_control.cli.app:app``.
"""
