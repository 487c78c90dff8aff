"""The kinds of reasons that the connection to KUKA's cabinets gives."""

from __future__ import annotations

from q2r2_control.events import ReasonKind


class FriReason(ReasonKind):
    """Why a cabinet is not commanded."""

    FRI_SILENT = "fri_silent", "{arm}: no FRI message from {source}"
    FRI_UNREADABLE = "fri_unreadable", "{arm}: {source}: {text}"
    FRI_SESSION = (
        "fri_session",
        "{arm}: the cabinet is in {session}, connection {quality}, safety {safety}, drives {drives}; "
        "commands are followed in commanding active, without a stop of the safety controller",
    )
    FRI_COMMAND_MODE = "fri_command_mode", "{arm}: the Sunrise application asks for {asked} commands; allowed: {wanted}"
    FRI_TOO_SELDOM = (
        "fri_too_seldom",
        "{arm}: the cabinet asks every {period:g} ms; allowed for torques: {allowed:g} at most",
    )
    FRI_DROPPED = "fri_dropped", "{arm}: the cabinet ended the session"
    FRI_BEHIND = "fri_behind", "{arm}: the cabinet asks less often than every {period:g} ms, and is {lag:.2f} s behind"
    FRI_OVERTAKEN = "fri_overtaken", "the control loop was too late for the cabinets"
