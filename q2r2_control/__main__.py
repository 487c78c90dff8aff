"""``python -m q2r2_control`` is the ``q2r2`` command."""

import os
import signal
import sys


def main() -> None:
    """Run the command. Until the command begins, Ctrl-C ends the program at once, without a traceback."""
    # One thread is enough, because matrices are small here. With several threads, most of the time is spent on waiting,
    # and the computation takes ten times as long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    handler = signal.signal(signal.SIGINT, signal.SIG_DFL)
    from q2r2_control.cli.app import app

    signal.signal(signal.SIGINT, handler)
    try:
        app()
    except KeyboardInterrupt:  # Ctrl-C was pressed while the command line was read.
        sys.exit(128 + signal.SIGINT)


if __name__ == "__main__":
    main()
