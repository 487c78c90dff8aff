"""Check the actions of a policy, and log the traceback of a policy that failed."""

from __future__ import annotations

import logging
import traceback
from collections.abc import Sequence
from typing import Any

import numpy as np

from q2r2_control.errors import shown
from q2r2_control.types import Array

_LARGEST = 1e3  # Largest allowed absolute value of a number in an action [m or rad].
_logger = logging.getLogger(__name__)


class UnusableError(Exception):
    """Raised if actions cannot be used. The message says why."""


def numbers_of(what: str, values: Any) -> Array:
    """Return a copy of the ``values`` as an array; raises :class:`UnusableError` if they are not numbers."""
    if values is None:
        raise UnusableError(f"{what} are None; allowed: an array of numbers")
    try:
        return np.array(values, dtype=np.float64)  # A copy, because the sender can change its array later.
    except (TypeError, ValueError, OverflowError) as error:
        raise UnusableError(f"{what} = {shown(values)}; allowed: an array of numbers ({error})") from error


def check_finite(values: Array, names: Sequence[str]) -> None:
    """Raise :class:`UnusableError` if a number of ``values`` (n, size) is not finite, or is too large."""
    if not (usable := np.abs(values) <= _LARGEST).all():  # The comparison is also False for NaN.
        action, column = np.argwhere(~usable)[0]
        allowed = f"allowed: finite numbers, {_LARGEST:g} at most"
        raise UnusableError(f"action {action}: {names[column]} = {values[action, column]}; {allowed}")


def check_names(names: Sequence[str], expected: Sequence[str], grippers: Sequence[str]) -> None:
    """Raise :class:`UnusableError` if ``names`` have to be refused.

    All ``expected`` names have to come first, in their order. Any of ``grippers`` may follow, in their order.
    """
    for place, name in enumerate(expected):
        if place >= len(names) or names[place] != name:
            found = shown(names[place]) if place < len(names) else "missing"
            raise UnusableError(f"number {place} is {found}; allowed: {name}, in the order {', '.join(expected)}")
    behind = list(names[len(expected) :])
    if behind != [name for name in grippers if name in behind]:
        raise UnusableError(f"names end with {shown(behind)}; allowed: {', '.join(grippers)}, in this order")


class PolicyErrors:
    """Logs the traceback of each error of a policy once, although the policy is called many times a second."""

    def __init__(self) -> None:
        self._shown: set[str] = set()  # Types of errors, and the lines that raised them.

    def show(self, error: BaseException) -> None:
        """Log ``error`` with its traceback, unless this type was logged from the same line before."""
        own = error.__traceback__  # The first stack frame is left out, because it is the caller of the policy.
        trace = None if own is None else own.tb_next
        frames = traceback.extract_tb(trace)
        place = f"{type(error).__name__} {[(frame.filename, frame.lineno) for frame in frames[-1:]]}"
        if place not in self._shown:
            self._shown.add(place)
            lines = "".join(traceback.format_exception(type(error), error, trace)).rstrip()
            _logger.error("the policy failed; this traceback is shown once:\n%s", lines)
