"""The one exception root: every error the package raises on purpose says what, where and what is allowed."""

from __future__ import annotations

from collections.abc import Sequence


class Q2R2Error(Exception):
    """Root of all errors that q2r2_control raises on purpose."""


class ConfigError(Q2R2Error):
    """A configuration cannot be used; the message names file, key, value and what is allowed.

    Attributes:
        faults: A line for each thing that is wrong, where more than one is known; else the message alone.
    """

    def __init__(self, message: str, faults: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.faults = tuple(faults) or (message,)

    def at(self, where: str) -> ConfigError:
        """The same error, of which all lines begin with ``where``."""
        return ConfigError(f"{where}{self}", [f"{where}{fault}" for fault in self.faults])


class RobotError(Q2R2Error):
    """A robot description cannot be loaded or does not have what the controller needs."""


class ProtocolError(Q2R2Error):
    """A peer sent bytes that its protocol does not allow; the message says which and what is allowed."""


class InputError(Q2R2Error):
    """An input cannot be opened; the message says which and why."""


class PlantError(Q2R2Error):
    """A plant cannot be built or driven as asked; the message says what was wrong and what is allowed."""


class RecordingError(Q2R2Error):
    """A recording cannot be read or replayed; the message names the file, what is wrong and what is allowed."""


def shown(value: object, length: int = 60) -> str:
    """``value`` for an error: one line of at most ``length`` characters."""
    try:
        text = repr(value)
    except Exception:  # an integer of thousands of digits, or an object of somebody else's
        text = f"a value of type {type(value).__name__} that cannot be shown"
    return " ".join(text.split())[:length]


def raised(error: BaseException, length: int = 200) -> str:
    """One line about an exception of a stranger's code: its kind, and its text, where that can be printed."""
    try:
        said = " ".join(str(error).split())[:length]
    except Exception:
        said = "it cannot be printed"
    return f"{type(error).__name__}: {said}"


def check_kind(
    name: str, value: object, kind: type | tuple[type, ...], allowed: str, error: type[Q2R2Error] = ConfigError
) -> None:
    """Raise an ``error`` that says what is ``allowed`` unless ``value`` is of a ``kind``."""
    if not isinstance(value, kind):
        raise error(f"{name} = {shown(value)}: allowed: {allowed}")
