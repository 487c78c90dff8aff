"""``python -m q2r2_control`` is the ``q2r2`` command."""

from q2r2_control.cli.app import app

app()
