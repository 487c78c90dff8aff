"""Wait for cabinets that a person has to start, and log what this person has to do and how long the wait has lasted."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable

from q2r2_control.plants.fri.session_state import SessionState
from q2r2_control.plants.fri.wire import Session

_CHECK_PERIOD = 0.01  # Time between two checks of the cabinets [s].
_FIRST_LINE, _BETWEEN_LINES = 3.0, 10.0  # Delay of the first line in the log, and time between two lines [s].
_START = (
    "start its FRI application at the smartPAD: choose it, in T1 or T2 hold the enabling switch, press the play key"
)
_TO_DO = {
    Session.IDLE: _START,
    Session.MONITORING_WAIT: "the connection is not good yet: wait, or see to the network and to this computer's load",
    Session.MONITORING_READY: "let its application start the overlay: answer its question at the smartPAD",
    Session.COMMANDING_WAIT: (
        "the drives or the load data hold it up: press the play key, in T1 or T2 with the enabling switch, and see "
        "whether the load data are those of the tool"
    ),
    Session.COMMANDING_ACTIVE: "end the stop at the smartPAD, or choose what is asked for in its application",
}
_logger = logging.getLogger(__name__)


class CabinetWait:
    """Waits for cabinets, and logs what is missing after three seconds and then every ten seconds.

    The waiting time counts from the creation of the instance.
    """

    def __init__(
        self, stopped: Callable[[], bool] = lambda: False, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """``stopped`` returns True if the wait is to end; ``clock`` is the clock of the states [s]."""
        self._stopped, self._clock, self._began = stopped, clock, clock()
        self._next_line = self._began + _FIRST_LINE

    @property
    def passed(self) -> float:
        """Time since the beginning of the wait [s]."""
        return self._clock() - self._began

    @property
    def was_stopped(self) -> bool:
        return self._stopped()

    def until(self, done: Callable[[], bool], states: Callable[[], Iterable[SessionState]], longest: float) -> bool:
        """Wait until ``done()`` is True, at most until ``longest`` [s] after this instance was created.

        Args:
            done: Checks the cabinets, and returns True if there is nothing left to wait for.
            states: Returns the states of all arms' sessions, which are logged.
            longest: The longest wait; infinite if there is no bound [s].

        Returns:
            True if ``done`` returned True; False if the time was over, or somebody ended the wait.
        """
        while not done():
            now = self._clock()
            if self._stopped() or now - self._began >= longest:
                return False
            if now >= self._next_line:
                self._next_line = now + _BETWEEN_LINES
                still = "" if now - self._began < _BETWEEN_LINES else f" still, for {now - self._began:.0f} s"
                missing = "; ".join(what_is_missing(state, now) for state in states() if state.fault(now) is not None)
                _logger.info("waits%s: %s; Ctrl-C ends the wait", still, missing)
            time.sleep(_CHECK_PERIOD)
        return True


def what_is_missing(state: SessionState, now: float) -> str:
    """Return a line for the operator: the state of a cabinet's session, and what to do there."""
    newest = state.newest
    if newest is None or state.is_silent(now):
        if state.problem is not None:
            return f"{state.arm}: {state.source}: {state.problem}"
        return f"{state.arm}: no FRI message from {state.source} of this computer; {_START}"
    return f"{state.arm}: {state.source} is in {state.words}; {_TO_DO[newest.session]}"
