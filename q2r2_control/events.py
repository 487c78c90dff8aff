"""Events of the arms as data: a kind and its details. Code uses the kind, and :mod:`wording` makes sentences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from typing import Any

from q2r2_control.plugins import REASONS, load_class, names_of


class ReasonKind(StrEnum):
    """A kind of reason: for a change of an arm's state, for a refusal, for a result, or for a fault.

    Each subpackage that gives reasons has an enum of its own kinds, a subclass of this class, such as
    :class:`TeleopReason`. The enum is an entry point of the group ``q2r2_control.reasons``, so that recordings and
    messages that contain its kinds can be read.

    The values never change, so that old recordings stay readable. Each kind has the ``template`` of its sentence. The
    fields of the template are the details of the reason, and ``cause`` is the sentence of its cause.
    """

    template: str

    def __new__(cls, value: str, template: str = "") -> ReasonKind:
        kind = str.__new__(cls, value)
        kind._value_, kind.template = value, template
        return kind


class CommonReason(ReasonKind):
    """Kinds of reasons that several subpackages give."""

    # The motion home.
    HOMING = "homing", "way home"
    HOMING_ARRIVED = "homing_arrived", "at home"
    HOMING_HELD_UP = "homing_held_up", "held up by {by}"
    HOMING_NO_WAY = "homing_no_way", "no free way was found"
    HOMING_INTERRUPTED = "homing_interrupted", "the way home was interrupted"
    HOMING_ENDED = "homing_ended", "the way home was ended"
    HOMING_FAULT = "homing_fault", "on the way home: {cause}"
    # Other kinds.
    POLICY_UNUSABLE = "policy_unusable", "actions of the policy that cannot be used: {text}"
    LOOP_STALLED = "loop_stalled", "the control loop stood still for {duration:.3f} s"
    OTHER = "other", "{text}"  # The sentence was made elsewhere. No code makes a decision from it.


@cache
def _kinds() -> dict[str, ReasonKind]:
    enums: list[type[ReasonKind]] = [CommonReason, *(load_class(REASONS, name) for name in names_of(REASONS))]
    return {str(kind): kind for enum in enums for kind in enum}


def is_kind(value: str) -> bool:
    """Return whether this package, or another installed package, has a kind with this value."""
    return value in _kinds()


def kind_named(value: str) -> ReasonKind:
    """Return the kind with this value, from any subpackage. Raises :class:`ValueError` if no kind has the value."""
    if not is_kind(value):
        raise ValueError(f"no room has the kind of reason {value!r:.60}")
    return _kinds()[value]


@dataclass(frozen=True, slots=True)
class Reason:
    """A kind with its details, which are numbers in SI units, texts, names, and lists of these."""

    kind: ReasonKind
    detail: Mapping[str, Any] = field(default_factory=dict)
    cause: Reason | None = None  # The reason from which this reason follows.

    @classmethod
    def of(cls, kind: ReasonKind, cause: Reason | None = None, **detail: Any) -> Reason:
        """Make a reason, with its details as keyword arguments."""
        return cls(kind, detail, cause)

    @classmethod
    def in_words(cls, text: str) -> Reason:
        """Make a reason from a sentence. No code makes a decision from this reason."""
        return cls(CommonReason.OTHER, {"text": text})

    @property
    def root(self) -> Reason:
        return self if self.cause is None else self.cause.root

    def as_json(self) -> dict[str, Any]:
        """Return data for ``json.dumps``. Empty fields are left out."""
        data: dict[str, Any] = {"kind": str(self.kind)}
        if self.detail:
            data["detail"] = dict(self.detail)
        if self.cause is not None:
            data["cause"] = self.cause.as_json()
        return data

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Reason:
        """Make the reason from the data of :meth:`as_json`.

        Raises:
            ValueError, KeyError, TypeError: For other data, and for a kind that no installed package has.
        """
        cause = cls.from_json(data["cause"]) if "cause" in data else None
        return cls(kind_named(data["kind"]), dict(data.get("detail", {})), cause)


@dataclass(frozen=True, slots=True)
class Event:
    """A change of an arm's state. If both states are the same, the event is only news for the operator."""

    t: float  # Time of the event [s].
    arm: str
    source: str  # The arm's state before the event.
    destination: str  # The arm's state after the event.
    reason: Reason

    @property
    def kind(self) -> ReasonKind:
        return self.reason.kind

    def as_json(self) -> dict[str, Any]:
        """Return data for ``json.dumps``: ``t``, ``arm``, ``from``, ``to``, ``kind``, and ``detail`` and ``cause``."""
        states = {"from": str(self.source), "to": str(self.destination)}
        return {"t": self.t, "arm": self.arm, **states, **self.reason.as_json()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Event:
        """Make the event from the data of :meth:`as_json`.

        Raises:
            ValueError, KeyError, TypeError: For other data, and for a kind that no installed package has.
        """
        return cls(float(data["t"]), data["arm"], data["from"], data["to"], Reason.from_json(data))
