"""How a process that runs a loop is asked to end."""

from __future__ import annotations

import subprocess
import sys

# Sends a signal at every line that the first signal's handler runs, so each of them is interrupted by another handler.
SCRIPT = """
import os, signal, sys
from q2r2_control.process.scheduling import StopRequest
stop, sent = StopRequest(), []
def trace(frame, event, arg):
    if event == "line" and len(sent) < 20:
        sent.append(frame.f_lineno)
        os.kill(os.getpid(), signal.SIGTERM)
    return trace
signal.signal(signal.SIGTERM, lambda *_: stop.ask())
sys.settrace(trace)
stop.ask()
sys.settrace(None)
print(stop.asked, len(sent) > 0)
"""


def test_a_signal_in_the_middle_of_another_one_s_handler_does_not_wait_for_it() -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["True", "True"], done.stderr
