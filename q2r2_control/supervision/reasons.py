"""The kinds of reasons that supervision gives."""

from __future__ import annotations

from q2r2_control.events import CommonReason, ReasonKind


class SupervisionReason(ReasonKind):
    """What supervision finds, why it stops the arms, and why it does not follow a target."""

    # A finding of supervision and of the ROS nodes.
    CONTROLLER_STANDS = (
        "controller_stands",
        "the {arm} arm's controller{takers} stands still: the arm is measured, and does not go the {way:.3f} {unit} "
        "that it was asked to in {time:g} s",
    )
    # Findings of supervision.
    NO_STATES_YET = "no_states_yet", "no joint states yet{source}"
    STATES_SILENT = "states_silent", "no joint states{source} for {age:.3f} s; allowed: {timeout:g}"
    STATE_NOT_FINITE = (
        "state_not_finite",
        "measured {quantity} of {joint} = {value} for more than {bridged:g} ms; allowed: finite numbers",
    )
    STATE_JUMPED = "state_jumped", "{joint} jumped by {distance:.3f} rad"
    JOINT_STATES = "joint_states", "joint states: {cause}"
    PLANT_FAULT = "plant_fault", "the plant reports a fault: {cause}"
    OFF_REFERENCE = (
        "off_reference",
        "{joint} is {deviation:.3f} rad from its reference for {time:.1f} s; "
        "allowed: {allowed:g} rad for {allowed_time:g} s",
    )
    TOO_HEAVY = (
        "too_heavy",
        "{joint} is {deviation:.3f} rad from its reference for {time:.1f} s, "
        "and gravity alone asks it for {needed:.1f} Nm; "
        "allowed: {allowed:g} rad for {allowed_time:g} s, and its torque limit, {limit:g} Nm",
    )
    TOO_CLOSE = (
        "too_close",
        "measured: {pair} are {distance:.4f} m apart; "
        "allowed: {allowed:.4f}, {key} {kept:g} less distance_tolerance {tolerance:g}",
    )
    LEFT_BEHIND = (
        "left_behind",
        "{arm}: the tool is {distance:.3f} m and {angle:.2f} rad from where it was led; begins anew where it is",
    )
    # Why arms are activated again, what happens to them, and why a target is not followed.
    ARMS_APART = "arms_apart", "{arm}: {skew:.0f} ms behind the other arm; allowed: {allowed:.0f} ms"
    RUN_ENDED = "run_ended", "the run has ended"
    ACTIVATED = "activated", "active: the reference starts at the measured posture"
    HOMING_OUTCOME = "homing_outcome", "homing ended: {cause}"
    # The controller follows no targets in this phase.
    CONTROLLER_PHASE = "controller_phase", "the controller is {phase}"
    CONTROLLER_PAUSED = "controller_paused", "the controller is paused"
    ARMS_HOMING = "arms_homing", "the arms are on their way home"
    ARMS_BRAKING = "arms_braking", "the arms are braking"
    STREAM_AWAY = (
        "stream_away",
        "the stream is {distance:.3f} m and {angle:.2f} rad from the tool; to be followed it has to begin anew "
        "within {engage_distance:g} m and {engage_angle:g} rad",
    )
    PUBLISHER_CHANGED = "publisher_changed", "another publisher took over{source}; the targets have to begin anew"
    TWO_PUBLISHERS = "two_publishers", "two publishers at a time{source}; allowed: one"
    TARGETS_CEASED = "targets_ceased", "{arm} holds because its targets{source} have ceased"
    TARGETS_LINKED = "targets_linked", "{arm} holds because it is linked to {other}: {cause}"


# Kinds of reasons that report no fault.
ROUTINE: frozenset[ReasonKind] = frozenset({SupervisionReason.ACTIVATED, CommonReason.HOMING_ARRIVED})
