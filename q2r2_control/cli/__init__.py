"""The ``q2r2`` command: ``app`` is the whole, in which every error ends in one line and exit code 2.

``commands`` lists the subcommands and where they are; each is imported when it is called. They share ``cell_run``,
``cell_report`` and ``output``.
"""
