"""The ``q2r2`` command. ``app`` is the whole command, and turns every error into one line and exit code 2.

``commands`` lists the subcommands and their modules. The module of a subcommand is imported only when the subcommand is
called. The modules of the subcommands share ``cell_run``, ``cell_report`` and ``output``.
"""
