"""How long does it take from a press until the arm moves, for the first press after the nodes start and for later ones?

All nodes are started again for each first press. The hand always goes round a circle, so an engaged arm moves at once.
At the end of each tick, the arm's node publishes its flags for recorders, so these messages show when its ticks end.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import rclpy
import typer
from geometry_msgs.msg import PoseStamped
from quest2ros.msg import OVR2ROSInputs
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory

from q2r2_control.cli.output import DEMO_CONFIG, Json, print_progress, print_report
from q2r2_control.errors import Q2R2Error
from q2r2_control.recording.messages import ARM_FIELDS, arm_flags, asked_target
from q2r2_control.ros.base_node import RECORDED_QOS, STREAM_QOS
from q2r2_control.ros.launch.processes import nodes_of
from q2r2_control.types import Array
from q2r2_control.viewer.tables import record_table
from ros_processes import private_domain, started

_LATER_PRESSES = 4  # Number of presses that engage the arm after the first one, at each start of the nodes.
_START_TIMEOUT_S = 300.0  # Timeout for the nodes, which may have to compile kernels first [s].
# Duration of a press of the lower button, and of the pause after it. Both together are longer than WATCHED_S [s].
_PRESS_S = 0.3
_REST_SPEED, _REST_S = 0.005, 0.5  # The joints rest if all commands were below this speed [rad/s] for this time [s].
_SAMPLE_PERIOD_S = 1.0 / 75.0  # Period of the hand's samples [s].
_CIRCLE_RADIUS, _CIRCLE_PERIOD_S = 0.03, 2.0  # Radius of the hand's circle [m], and time of one turn [s].


WATCHED_S = 0.5  # Time after a press in which its answers are looked for [s].
_MOTION_SPEED = 0.02  # A joint command above this speed belongs to a motion [rad/s].


@dataclass(frozen=True, slots=True)
class PressRecording:
    """The answers to one press that should engage an arm at rest. Times are ascending and come from one clock [s]."""

    press: float  # Time when the press was published.
    ticks: Sequence[float]  # Time when each tick of the arm's node ended. Some are before the press.
    targets: Sequence[float]  # Time when each target was published.
    commands: Sequence[float]  # Time when each joint command was published.
    speeds: Sequence[float]  # Speed of the fastest joint in each joint command [rad/s].


@dataclass(frozen=True, slots=True)
class PressRow:
    """Medians and maxima of the presses of one kind [ms]. They are None if no press was answered."""

    press: str  # Kind of the presses.
    count: int  # Number of presses.
    unanswered: int  # Number of presses without an answer within half a second.
    tick_p50_ms: float | None  # Longest time between two ticks of the arm's node in the half second after a press.
    tick_max_ms: float | None
    target_p50_ms: float | None  # Time from a press until the first target.
    target_max_ms: float | None
    motion_p50_ms: float | None  # Time from a press until the first joint command of a motion.
    motion_max_ms: float | None


@dataclass(frozen=True, slots=True)
class PressReport:
    """The measured figures of all presses."""

    starts: int  # Number of starts of all nodes. Each start has one first press.
    period_ms: float  # Median time from one tick of the arm's node to the next.
    rows: tuple[PressRow, ...]


class PressError(Q2R2Error):
    """An error of nodes that were not ready in time. The message says what was waited for."""


def measure_presses(config: str, starts: int) -> PressReport:
    """Start the nodes ``starts`` times. After each start, press for the first time, and then four times more.

    Raises :class:`PressError` if the nodes are not ready in time.
    """
    runs = []
    for number in range(starts):
        with private_domain(), _Hand() as hand, started(nodes_of(config, "none")):
            print_progress(f"Waiting for the nodes, start {number + 1} of {starts}.")
            hand.wait_until_ready()
            run = [hand.press_to_engage()]
            for _ in range(_LATER_PRESSES):
                hand.pause()
                run.append(hand.press_to_engage())
            runs.append(run)
    return press_report(runs)


class _Hand:
    """A node for the left hand that records what the arm's node and the controller answer.

    Times are the stamps that the middleware sets at the sender.
    """

    def __init__(self) -> None:
        self._state: dict[str, Any] = {}
        self._engaged = self._pressed = False
        self._ticks: list[float] = []
        self._targets: list[float] = []
        self._commands: list[float] = []
        self._speeds: list[float] = []
        self._moved = math.inf  # Time of the last command that moved a joint, by the monotonic clock [s].
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("press_probe", context=self._context)
        # ``listen`` has the type Any, because rclpy's type hints lack callbacks that get the message's stamps.
        listen: Any = self._node.create_subscription
        listen(Float64MultiArray, arm_flags("left"), self._on_flags, RECORDED_QOS)
        listen(PoseStamped, asked_target("left"), self._on_target, RECORDED_QOS)
        listen(JointTrajectory, "/joint_trajectory", self._on_command, STREAM_QOS)
        self._node.create_subscription(String, "/left_q2r2_arm_controller/state", self._on_state, 10)
        self._pose = self._node.create_publisher(PoseStamped, "/q2r_left_hand_pose", STREAM_QOS)
        self._inputs = self._node.create_publisher(OVR2ROSInputs, "/q2r_left_hand_inputs", STREAM_QOS)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)

    def __enter__(self) -> _Hand:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def wait_until_ready(self) -> None:
        """Wait until the arm's node says that the arm can be engaged, and until the arms rest."""
        self._state = {}
        self._moved = time.monotonic()

        def ready() -> bool:
            rests = time.monotonic() - self._moved > _REST_S
            return bool(self._state.get("ready") and not self._engaged and self._ticks and self._commands and rests)

        self._wait(ready, "left_arm_controller to be ready, which says: {message}")

    def press_to_engage(self) -> PressRecording:
        """Press, and record what follows for longer than :data:`WATCHED_S`."""
        for times in (self._ticks, self._targets, self._commands, self._speeds):
            del times[:-1]
        press = time.time()  # The middleware's stamps are times of this clock too.
        self._press()
        return PressRecording(
            press, tuple(self._ticks), tuple(self._targets), tuple(self._commands), tuple(self._speeds)
        )

    def pause(self) -> None:
        """Press once more if the arm is engaged, and wait until it can be engaged again."""
        if self._engaged:
            self._press()
        self.wait_until_ready()

    def _press(self) -> None:
        self._pressed = True
        self._move(_PRESS_S)
        self._pressed = False
        self._move(_PRESS_S)

    def _wait(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + _START_TIMEOUT_S
        while not condition():
            if time.monotonic() > deadline:
                said = self._state.get("message", "nothing")
                raise PressError(f"waited {_START_TIMEOUT_S:g} s for {what.format(message=said)}")
            self._move(_SAMPLE_PERIOD_S)

    def _move(self, period: float) -> None:
        """Publish samples of the hand for ``period`` [s], and receive messages meanwhile."""
        end = time.monotonic() + period
        while (now := time.monotonic()) < end:
            self._inputs.publish(OVR2ROSInputs(button_lower=self._pressed))
            self._pose.publish(_on_circle(now))
            until = min(now + _SAMPLE_PERIOD_S, end)
            while (left := until - time.monotonic()) > 0.0:
                self._executor.spin_once(left)

    def _on_flags(self, message: Float64MultiArray, info: dict[str, int]) -> None:
        self._ticks.append(_sent(info))
        self._engaged = message.data[ARM_FIELDS.index("engaged")] > 0.0

    def _on_target(self, _: PoseStamped, info: dict[str, int]) -> None:
        self._targets.append(_sent(info))

    def _on_command(self, message: JointTrajectory, info: dict[str, int]) -> None:
        self._commands.append(_sent(info))
        self._speeds.append(max(abs(v) for v in message.points[0].velocities))
        if self._speeds[-1] > _REST_SPEED:
            self._moved = time.monotonic()

    def _on_state(self, message: String) -> None:
        self._state = json.loads(message.data)


def _sent(info: dict[str, int]) -> float:
    return 1e-9 * info["source_timestamp"]


def _on_circle(now: float) -> PoseStamped:
    """Return the hand's pose at the time ``now`` of the monotonic clock [s]."""
    message = PoseStamped()
    angle = 2.0 * math.pi * now / _CIRCLE_PERIOD_S
    message.pose.position.y, message.pose.position.z = (
        _CIRCLE_RADIUS * math.cos(angle),
        _CIRCLE_RADIUS * math.sin(angle),
    )
    message.pose.orientation.w = 1.0
    return message


def press_report(runs: Sequence[Sequence[PressRecording]]) -> PressReport:
    """Return the figures of ``runs``, which have the recordings of at least one press each, in their order."""
    gaps = np.concatenate([np.diff(recording.ticks) for run in runs for recording in run])
    first, later = [run[0] for run in runs], [recording for run in runs for recording in run[1:]]
    return PressReport(len(runs), 1e3 * float(np.median(gaps)), (_row("first", first), _row("later", later)))


def _row(press: str, recordings: Sequence[PressRecording]) -> PressRow:
    times = [_times(recording) for recording in recordings]
    answered = np.array([time for time in times if time is not None]).reshape(-1, 3)
    unanswered = len(times) - len(answered)
    if not len(answered):
        return PressRow(press, len(times), unanswered, *[None] * 6)
    both = 1e3 * np.stack([np.median(answered, axis=0), answered.max(axis=0)], axis=1)
    return PressRow(press, len(times), unanswered, *both.ravel().tolist())


def _times(recording: PressRecording) -> tuple[float, float, float] | None:
    """Return the longest tick, and the times from the press until the first target and the first motion [s].

    Returns None if the press was not answered.
    """
    press = recording.press
    target = _first(np.asarray(recording.targets), press)
    moving = np.asarray(recording.commands)[np.asarray(recording.speeds) > _MOTION_SPEED]
    motion = _first(moving, press)
    if target is None or motion is None:
        return None
    ticks = np.asarray(recording.ticks)
    # The tick before the press counts too, because the delay that the press causes begins there.
    begin, end = np.searchsorted(ticks, [press, press + WATCHED_S])
    longest = float(np.diff(ticks[max(begin - 1, 0) : end + 1]).max(initial=0.0))
    return longest, target, motion


def _first(times: Array, press: float) -> float | None:
    """Return the time from the press to the first of ``times`` after it [s]; None if none is within WATCHED_S."""
    after = times[(times >= press) & (times <= press + WATCHED_S)]
    return float(after[0] - press) if len(after) else None


def main(
    starts: Annotated[
        int, typer.Option(min=1, help="Number of starts of all nodes. Each start has one first press.")
    ] = 3,
    json: Json = False,
) -> None:
    """Print the times after a press: the longest tick of the arm's node, the first target, and the first motion."""
    report = measure_presses(DEMO_CONFIG, starts)
    notes = (
        f"tick: Longest tick of the arm's node within {WATCHED_S:g} s after the press. The median of all ticks is "
        f"{report.period_ms:.1f} ms.",
        "target: Time from the press until the first target.",
        "motion: Time from the press until the first joint command that moves.",
    )
    table = record_table(f"Time from a press until the arm moves, {starts} starts of the nodes", report.rows, notes)
    print_report(report, (table,), json)


if __name__ == "__main__":
    typer.run(main)
