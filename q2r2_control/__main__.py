"""``python -m q2r2_control`` is the ``q2r2`` command."""

import os
import signal


def main() -> None:
    """Run the command. While it is importing Ctrl-C ends it at once, without a traceback."""
    # Matrices are small here: threads that wait for each other cost ten times what they do.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    handler = signal.signal(signal.SIGINT, signal.SIG_DFL)
    from q2r2_control.cli.app import app

    signal.signal(signal.SIGINT, handler)
    app()


if __name__ == "__main__":
    main()
