"""The ``q2r2`` command. ``app`` is the whole command, and turns every error into one line and exit code 2.

``commands`` lists the subcommands and their modules. Each module is imported when its command is called. They share
``cell_run``, ``cell_report`` and ``output``.
"""
