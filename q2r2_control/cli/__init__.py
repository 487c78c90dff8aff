"""The ``q2r2`` command: one module a command, with its options and its printing."""
