"""The kinds of reasons why Franka arms cannot be commanded."""

from __future__ import annotations

from q2r2_control import ReasonKind


class FrankaReason(ReasonKind):
    """Why an arm is not commanded."""

    FRANKA_UNREACHABLE = "franka_unreachable", "{arm}: no connection to the robot at {address}: {text}"
    FRANKA_SILENT = "franka_silent", "{arm}: no state from the robot at {address}"
    FRANKA_NOT_READY = (
        "franka_not_ready",
        "{arm}: the robot at {address} is in the mode {mode}, with the errors {errors}; "
        "arms follow in the mode Move, which begins in the mode Idle",
    )
    FRANKA_STARTING = "franka_starting", "{arm}: the motion has not begun at the robot at {address}"
    FRANKA_ENDED = "franka_ended", "{arm}: the robot at {address} ended the motion: {text}"
    FRANKA_OVERTAKEN = "franka_overtaken", "the control loop was too late for the robots"
