"""An operator over TCP, in real time: tracking, re-anchoring, grippers, and connections that end in mid-motion.

Assertions about time allow for the machine's own delays, as measured; those about safety do not.
"""

from __future__ import annotations

import gc
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.inputs.headset import HeadsetServer
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.summary.tick import Tick
from q2r2_control.types import SIDES, Array, HandSample
from tests.support.processes import Watch, cell, changes, speed

pytestmark = pytest.mark.slow

CHECKOUT = Path(__file__).resolve().parents[1]
SESSION = 15.0  # [s]
# A tick that stretches the motion by more than this is no measure of tracking, nor is the time until it is made up [s].
LATE, MADE_UP = 0.005, 0.5


class ClockedServer(HeadsetServer):
    """Keeps the time of every poll by the loop's clock, which is not part of a tick."""

    def __init__(self) -> None:
        super().__init__(port=0)
        self.times: list[float] = []

    def poll(self, now: float) -> list[HandSample]:
        self.times.append(now)
        return super().poll(now)


@dataclass
class Live:
    """A run in another thread."""

    server: ClockedServer
    loop: Pipeline
    watch: Watch
    summary: RunSummary | None = None
    failure: BaseException | None = None
    delay: float = 0.0  # of teleoperation [s]
    sent: list[dict] = field(default_factory=list)  # the fake headset's log

    def run(self) -> None:
        try:
            self.summary = self.loop.run()
        except BaseException as failure:
            self.failure = failure

    @property
    def ticks(self) -> list[Tick]:
        """Those in which the input was polled, as many as there are ``times``."""
        return self.watch.ticks[: len(self.server.times)]

    def wait_for(self, what: str, condition: Callable[[], bool], timeout: float = 30.0) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            if self.failure is not None:
                raise self.failure
            assert time.monotonic() < deadline, f"timed out waiting for {what}"
            time.sleep(0.005)

    def headset(self, *arguments: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "tests.support.fake_headset", "--port", str(self.server.address[1])]
        return subprocess.Popen([*command, *arguments], cwd=CHECKOUT)


@contextmanager
def live(plant: str) -> Iterator[Live]:
    """A pipeline that listens, until the end of the block; then it is stopped, and a failure of the run raised."""
    server = ClockedServer()
    # Without the solver's time limit, so that a busy machine causes no fallback.
    config = cell().model_copy(update={"control": cell().control.model_copy(update={"solve_time_limit": None})})
    loop = Pipeline.from_config(config, input=server, plant=plant)
    run = Live(server, loop, Watch(loop), delay=loop.teleop.delay)
    thread = threading.Thread(target=run.run)
    gc.disable()  # it would go through all ticks that the watch keeps, for up to 0.2 s
    thread.start()
    try:
        run.wait_for("the first tick", lambda: bool(run.watch.ticks))
        yield run
    finally:
        loop.stop()
        thread.join(10.0)
        gc.enable()
    assert not thread.is_alive()
    if run.failure is not None:
        raise run.failure


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Live:
    """The whole session: both hands move, pause, the left one turns by 120 degrees, resume, close the grippers."""
    log = tmp_path_factory.mktemp("session") / "sent.jsonl"
    with live("mujoco") as run:
        headset = run.headset("--dialect", "ros2", "--duration", str(SESSION), "--log", str(log))
        assert headset.wait() == 0
    run.sent = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    return run


def hand_path(session: Live, hand: str) -> tuple[Array, Array, list[pin.SE3]]:
    """Times (n,) [s], positions (n, 3) [m] and poses that ``hand`` sent."""
    sent = [line for line in session.sent if line["hand"] == hand]
    poses = [pin.XYZQUATToSE3((*line["position"], *line["quaternion"])) for line in sent]
    return np.array([line["t"] for line in sent]), np.array([pose.translation for pose in poses]), poses


@pytest.mark.parametrize("arm", SIDES)
class TestSession:
    def test_the_buttons_engage_pause_and_resume_and_nothing_else_does(self, session: Live, arm: str) -> None:
        assert session.summary is not None
        assert changes(session.summary.events, arm)[:4] == [
            ("idle", "engaged", "pressed"),
            ("engaged", "pausing", "pressed"),
            ("pausing", "paused", "pressed"),
            ("paused", "engaged", "pressed"),
        ]

    def test_the_first_target_after_engaging_and_resuming_is_where_the_tool_was_measured(
        self, session: Live, arm: str
    ) -> None:
        starts = session.watch.engagements(arm)
        assert len(starts) == 2
        for index in starts:
            tick = session.watch.ticks[index]
            target = tick.targets[arm].pose
            assert target is not None
            assert np.linalg.norm(target.translation - tick.tools[arm].translation) < 1e-6
            # Nothing jumps afterwards either: the hands still rest.
            rested = np.searchsorted(session.server.times, session.server.times[index] + 0.1) - 1
            before, after = tick.tools[arm], session.watch.ticks[rested].tools[arm]
            assert np.linalg.norm(after.translation - before.translation) < 1e-3
            assert np.linalg.norm(pin.log3(before.rotation.T @ after.rotation)) < np.radians(0.5)

    def test_the_tool_follows_the_hand_that_was_within_5_mm_and_1_degree(self, session: Live, arm: str) -> None:
        times, positions, poses = hand_path(session, arm)
        clock, ticks = session.server.times, session.ticks
        shifts, turns, travelled = [], [], []
        for start in session.watch.engagements(arm):
            anchor, index = poses[np.searchsorted(times, clock[start]) - 1], start
            tool = ticks[start].tools[arm]
            late_until = 0.0
            while index < len(ticks) and ticks[index].engaged[arm] and clock[index] < times[-1]:
                due = clock[index] - session.delay
                if ticks[index].dt - ticks[index].step > LATE:
                    late_until = clock[index] + MADE_UP
                if due > times[0]:
                    wanted = np.array([np.interp(due, times, column) for column in positions.T]) - anchor.translation
                    nearest = poses[int(np.argmin(np.abs(times - due)))]
                    turn = nearest.rotation @ anchor.rotation.T
                    got = ticks[index].tools[arm]
                    travelled.append(np.linalg.norm(wanted))
                    if clock[index] >= late_until:
                        shifts.append(np.linalg.norm(got.translation - tool.translation - wanted))
                        turns.append(np.linalg.norm(pin.log3(got.rotation @ (turn @ tool.rotation).T)))
                index += 1
        left_out = f"{len(travelled) - len(shifts)} of {len(travelled)} ticks left out, since the machine was late"
        print(f"{arm}: {left_out}")
        assert max(travelled) > 0.19, "circles of 0.1 m radius"
        assert np.sqrt(np.mean(np.square(shifts))) < 5e-3, left_out
        assert np.degrees(np.sqrt(np.mean(np.square(turns)))) < 1.0, left_out

    def test_the_tool_stands_still_while_the_hand_turns_in_the_pause(self, session: Live, arm: str) -> None:
        _, resumed = session.watch.engagements(arm)
        middle = [tick for tick in session.ticks if -1.5 < tick.t - session.watch.ticks[resumed].t < -0.1]
        assert len(middle) > 100
        assert max(map(speed, middle)) < 1e-3
        assert np.ptp([tick.tools[arm].translation for tick in middle], axis=0).max() < 1e-4

    def test_the_gripper_closes(self, session: Live, arm: str) -> None:
        _, second = session.watch.engagements(arm)
        assert session.watch.ticks[second].grippers[arm] > 0.95
        assert session.watch.ticks[-1].grippers[arm] < 0.05
        assert session.summary is not None
        assert session.summary.arms[arm].gripper_changes == 1


def test_the_session_needs_no_fallback_and_ends_at_rest(session: Live) -> None:
    summary = session.summary
    assert summary is not None
    assert summary.fallback_ticks == summary.uncertified_ticks == summary.rejected_targets == 0
    assert summary.at_rest
    assert summary.max_velocity_ratio <= 1.0 + 1e-9
    assert summary.max_acceleration_ratio <= 1.0 + 1e-9
    assert summary.min_position_margin_rad >= -1e-9


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "silent"])
def test_both_arms_come_to_rest_when_a_headset_ends_in_mid_motion_and_stay_whatever_the_hands_do(end: int) -> None:
    with live("kinematic") as run:
        headset = run.headset("--script", "circle", "--dialect", "ros1", "--duration", "20")
        try:
            run.wait_for(
                "motion", lambda: all(run.watch.ticks[-1].engaged.values()) and speed(run.watch.ticks[-1]) > 0.1
            )
            headset.send_signal(end)
            run.wait_for("a pause", lambda: not any(run.watch.ticks[-1].engaged.values()))
            mark = len(run.watch.ticks)
            time.sleep(0.5)
            headset.send_signal(signal.SIGCONT)  # the hands have moved meanwhile, and go on moving
            time.sleep(0.7)
        finally:
            headset.kill()
            headset.wait()
    ticks = run.ticks
    last = max(index for index in range(mark) if ticks[index].samples)
    rest = next(index for index in range(last, len(ticks)) if speed(ticks[index]) < 1e-3)
    assert speed(ticks[last]) > 0.05, "in mid-motion"
    limit = run.loop.robot.capped_acceleration(run.loop.config.control.acceleration_limit)
    braking = max(float((np.abs(tick.reference.v) / limit).max()) for tick in ticks[last:rest])
    # A late tick sees the timeout late, and the end of the braking one tick later.
    late = 3.0 * max(tick.dt for tick in ticks[last : rest + 1])
    received = max(sample.pose_stamp for sample in ticks[last].samples)
    assert run.server.times[rest] - received <= STREAM_TIMEOUT + braking + late + 0.005
    still = ticks[rest:]
    assert max(map(speed, still)) < 1e-3
    assert np.ptp([tick.reference.q for tick in still], axis=0).max() < 1e-4
    assert end is signal.SIGKILL or any(tick.samples for tick in still), "hands went on sending"
    assert run.summary is not None
    silent = ("pose_silent", "pose_gap", "inputs_silent", "hand_jumped", "linked")
    for arm in SIDES:
        event = next(event for event in run.summary.events if event.arm == arm and event.t >= ticks[last].t - 0.01)
        assert (str(event.source), str(event.destination)) == ("engaged", "lost")
        assert event.kind in (silent if end is signal.SIGSTOP else ("connection_lost",))
