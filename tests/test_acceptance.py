"""An operator over TCP: tracking, re-anchoring and grippers, and connections that end in mid-motion.

The session's bytes are real and its time is simulated, so that no machine is too slow to follow a hand. Ends of
connections are in real time: assertions about time allow for the machine's own delays, as measured; those about safety
do not.
"""

from __future__ import annotations

import gc
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.inputs.headset import HeadsetServer
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.summary.tick import Tick
from q2r2_control.types import SIDES, HandSample
from tests.support.fake_headset import RATE_HZ, send_reading
from tests.support.headset_server import eventually, registered
from tests.support.operator_script import HANDS, Reading, Script, acceptance_script
from tests.support.processes import Watch, cell, changes, speed

pytestmark = pytest.mark.slow

CHECKOUT = Path(__file__).resolve().parents[1]
SESSION = 15.0  # [s]


class PlayedSession(HeadsetServer):
    """A server in simulated time, to which a headset sends by TCP, before each poll, the script's part until then."""

    def __init__(self, script: Script) -> None:
        super().__init__(port=0, clock=lambda: self.now)
        self.now = 0.0
        self.sent: dict[str, list[Reading]] = {hand: [] for hand in HANDS}
        self.stamps: list[float] = []  # of each hand's readings [s]
        self._script, self._noise = script, random.Random(0)

    def start(self) -> None:
        super().start()
        self._headset = registered(self)

    def close(self) -> None:
        self._headset.close()
        super().close()

    def poll(self, now: float) -> list[HandSample]:
        samples: list[HandSample] = []
        while (due := len(self.stamps) / RATE_HZ) <= min(now, SESSION):
            self.now = due
            self.stamps.append(due)
            self._headset.discard_received()
            for reading in (self._script.reading(hand, due) for hand in HANDS):
                send_reading(self._headset, reading, self._noise)
                self.sent[reading.hand].append(reading)

            def arrived(due: float = due) -> bool:
                samples.extend(super(PlayedSession, self).poll(now))
                return any(sample.hand == HANDS[-1] and sample.inputs_stamp == due for sample in samples[-1:])

            eventually(arrived, "the last message of both hands")
        self.now = now
        return samples


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
def live() -> Iterator[Live]:
    """A pipeline that listens, until the end of the block; then it is stopped, and a failure of the run raised."""
    server = ClockedServer()
    # Without the solver's time limit, so that a busy machine causes no fallback.
    config = cell().model_copy(update={"control": cell().control.model_copy(update={"solve_time_limit": None})})
    loop = Pipeline.from_config(config, input=server, plant="kinematic")
    run = Live(server, loop, Watch(loop))
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


@dataclass
class Session:
    """A session that was played, and the ticks of its run."""

    headset: PlayedSession
    watch: Watch
    summary: RunSummary
    delay: float  # of teleoperation [s]


@pytest.fixture(scope="module")
def session() -> Session:
    """The whole session: both hands move, pause, the left one turns by 120 degrees, resume, close the grippers."""
    headset = PlayedSession(acceptance_script(SESSION))
    pipeline = Pipeline.from_config(cell(), input=headset, plant="mujoco")
    watch = Watch(pipeline)
    return Session(headset, watch, pipeline.run(SESSION, realtime=False), pipeline.teleop.delay)


@pytest.mark.parametrize("arm", SIDES)
class TestSession:
    def test_the_buttons_engage_pause_and_resume_and_nothing_else_does(self, session: Session, arm: str) -> None:
        assert changes(session.summary.events, arm)[:4] == [
            ("idle", "engaged", "pressed"),
            ("engaged", "pausing", "pressed"),
            ("pausing", "paused", "pressed"),
            ("paused", "engaged", "pressed"),
        ]

    def test_the_first_target_after_engaging_and_resuming_is_where_the_tool_was_measured(
        self, session: Session, arm: str
    ) -> None:
        starts = session.watch.engagements(arm)
        assert len(starts) == 2
        for index in starts:
            tick = session.watch.ticks[index]
            target = tick.targets[arm].pose
            assert target is not None
            assert np.linalg.norm(target.translation - tick.tools[arm].translation) < 1e-6
            # Nothing jumps afterwards either: the hands still rest.
            rested = next(later for later in session.watch.ticks[index:] if later.t >= tick.t + 0.1)
            before, after = tick.tools[arm], rested.tools[arm]
            assert np.linalg.norm(after.translation - before.translation) < 1e-3
            assert np.linalg.norm(pin.log3(before.rotation.T @ after.rotation)) < np.radians(0.5)

    def test_the_tool_follows_the_hand_that_was_within_5_mm_and_1_degree(self, session: Session, arm: str) -> None:
        times = np.array(session.headset.stamps)
        poses = [pin.XYZQUATToSE3((*sent.position, *sent.quaternion)) for sent in session.headset.sent[arm]]
        positions = np.array([pose.translation for pose in poses])
        ticks = session.watch.ticks
        shifts, turns, travelled = [], [], []
        for start in session.watch.engagements(arm):
            anchor, tool = poses[np.searchsorted(times, ticks[start].now) - 1], ticks[start].tools[arm]
            for tick in ticks[start:]:
                if not tick.engaged[arm]:
                    break
                due = tick.now - session.delay
                wanted = np.array([np.interp(due, times, column) for column in positions.T]) - anchor.translation
                turn = poses[int(np.argmin(np.abs(times - due)))].rotation @ anchor.rotation.T
                got = tick.tools[arm]
                travelled.append(np.linalg.norm(wanted))
                shifts.append(np.linalg.norm(got.translation - tool.translation - wanted))
                turns.append(np.linalg.norm(pin.log3(got.rotation @ (turn @ tool.rotation).T)))
        assert max(travelled) > 0.19, "circles of 0.1 m radius"
        assert np.sqrt(np.mean(np.square(shifts))) < 5e-3
        assert np.degrees(np.sqrt(np.mean(np.square(turns)))) < 1.0

    def test_the_tool_stands_still_while_the_hand_turns_in_the_pause(self, session: Session, arm: str) -> None:
        _, resumed = session.watch.engagements(arm)
        middle = [tick for tick in session.watch.ticks if -1.5 < tick.t - session.watch.ticks[resumed].t < -0.1]
        assert len(middle) > 100
        assert max(map(speed, middle)) < 1e-3
        assert np.ptp([tick.tools[arm].translation for tick in middle], axis=0).max() < 1e-4

    def test_the_gripper_closes(self, session: Session, arm: str) -> None:
        _, second = session.watch.engagements(arm)
        assert session.watch.ticks[second].grippers[arm] > 0.95
        assert session.watch.ticks[-1].grippers[arm] < 0.05
        assert session.summary.arms[arm].gripper_changes == 1


def test_the_session_needs_no_fallback_and_ends_at_rest(session: Session) -> None:
    summary = session.summary
    assert summary.fallback_ticks == summary.uncertified_ticks == summary.rejected_targets == 0
    assert summary.at_rest
    assert summary.max_velocity_ratio <= 1.0 + 1e-9
    assert summary.max_acceleration_ratio <= 1.0 + 1e-9
    assert summary.min_position_margin_rad >= -1e-9


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "silent"])
def test_both_arms_come_to_rest_when_a_headset_ends_in_mid_motion_and_stay_whatever_the_hands_do(end: int) -> None:
    with live() as run:
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
