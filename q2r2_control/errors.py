"""The exceptions of this package. Every message says what is wrong, where, and what is allowed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager


class Q2R2Error(Exception):
    """Base class of all errors that q2r2_control raises on purpose.

    Attributes:
        faults: One line for each fault, if the faults are given; otherwise the message alone.
    """

    def __init__(self, message: str, faults: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.faults = tuple(faults) or (message,)


class ConfigError(Q2R2Error):
    """A configuration cannot be used. The message names file, key and value, and says what is allowed."""

    def at(self, where: str) -> ConfigError:
        """Return the same error with ``where`` at the beginning of each line."""
        return ConfigError(f"{where}{self}", [f"{where}{fault}" for fault in self.faults])


class MissingPackageError(ConfigError, ImportError):
    """A package of an extra is not installed. The message names what needs it, and the command that installs it."""


class AllFaults:
    """Collects the errors of several parts, so that a user reads all of them together.

    An error in ``with faults.of_part():`` ends that part only. The end of ``with AllFaults() as faults:`` raises a
    single error as it is, and several errors as one :class:`ConfigError`.
    """

    def __init__(self) -> None:
        self._errors: list[Q2R2Error] = []

    def __enter__(self) -> AllFaults:
        return self

    @contextmanager
    def of_part(self) -> Iterator[None]:
        try:
            yield
        except Q2R2Error as error:
            self._errors.append(error)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None or not self._errors:
            return
        if len(self._errors) == 1:
            raise self._errors[0]
        raise ConfigError("; ".join(map(str, self._errors)), [fault for one in self._errors for fault in one.faults])


class RobotError(Q2R2Error):
    """A robot description cannot be loaded, or lacks something that the controller needs."""


class ProtocolError(Q2R2Error):
    """A peer sent bytes that its protocol does not allow. The message says which bytes, and what is allowed."""


class InputError(Q2R2Error):
    """An input cannot be opened. The message names the input and says why."""


class PlantError(Q2R2Error):
    """A plant cannot be built or driven. The message says what is wrong and what is allowed."""


class CameraError(Q2R2Error):
    """A camera cannot be opened, or gives no more pictures. The message says which camera, why, and what is allowed."""


class RecordingError(Q2R2Error):
    """A recording cannot be read or replayed. The message names the file, what is wrong, and what is allowed."""


NOT_RECORDED = 3  # Exit code of a run that ended well, but whose recording is not complete.


def shown(value: object, length: int = 60) -> str:
    """Return ``value`` as one line of at most ``length`` characters, for an error message."""
    try:
        text = repr(value)
    except Exception:  # The value is an integer of thousands of digits, or an object whose repr fails.
        text = f"a value of type {type(value).__name__} that cannot be shown"
    return " ".join(text.split())[:length]


def raised(error: BaseException, length: int = 200) -> str:
    """Return one line about an exception of foreign code: its class, and its text if that can be printed."""
    try:
        said = " ".join(str(error).split())[:length]
    except Exception:
        said = "it cannot be printed"
    return f"{type(error).__name__}: {said}"


def check_kind(
    name: str, value: object, kind: type | tuple[type, ...], allowed: str, error: type[Q2R2Error] = ConfigError
) -> None:
    """Raise an ``error`` that says what is ``allowed``, unless ``value`` is an instance of ``kind``."""
    if not isinstance(value, kind):
        raise error(f"{name} = {shown(value)}: allowed: {allowed}")
