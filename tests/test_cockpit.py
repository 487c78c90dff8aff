"""What an operator's controls do, through the TCP door and with arms in MuJoCo; the contract at every tick."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from q2r2_control.inputs.headset import HeadsetServer
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.runtime.recorder import Tick
from tests.support.fake_headset import RATE_HZ, FakeHeadset, Sensor
from tests.support.operator_script import HANDS, START
from tests.support.watch import Watch, cell

pytestmark = pytest.mark.slow

BINDINGS = {"trigger": "stop", "grip": "home", "lower_double": "swap_hands"}
# Of the arrays of a headset's inputs: stick to the right, stick up, index finger, middle finger.
INDEX, MIDDLE = (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)
PATIENCE = 60.0  # [s]
PRESS = 0.2  # [s]
SETTLES = 0.5  # until a second tap could not come any more, and filters have [s]


class Cockpit:
    """A run that listens, and an operator's headset that streams to it."""

    def __init__(self) -> None:
        control = cell().control.model_copy(update={"solve_time_limit": None})
        # Longer than by default, so that other load on the machine does not look like a fault.
        teleop = cell().teleop.model_validate(
            {**cell().teleop.model_dump(), "bindings": BINDINGS, "gate": {"timeout": 2.0}}
        )
        config = cell().model_copy(update={"control": control, "teleop": teleop})
        self.server = HeadsetServer(port=0)
        self.loop = Pipeline.from_config(config, input=self.server, plant="mujoco")
        self.watch = Watch(self.loop)
        self.failure: BaseException | None = None
        self.lower: set[str] = set()
        self.analog: dict[str, tuple[float, ...]] = {}
        self.shift = np.zeros(3)  # of both hands [m]
        self._ended = threading.Event()

    @contextmanager
    def running(self) -> Iterator[Cockpit]:
        threads = [threading.Thread(target=self._run), threading.Thread(target=self._stream)]
        threads[0].start()
        self.wait("the first tick", lambda tick: True)
        threads[1].start()
        try:
            yield self
        finally:
            self._ended.set()
            self.loop.stop()
            for thread in threads:
                thread.join(PATIENCE)
        if self.failure is not None:
            raise self.failure

    def wait(self, what: str, condition: Callable[[Tick], bool]) -> Tick:
        """Wait until ``condition`` holds for the newest tick; returns it."""
        deadline = time.monotonic() + PATIENCE
        while not (self.watch.ticks and condition(self.watch.ticks[-1])):
            if self.failure is not None:
                raise self.failure
            assert time.monotonic() < deadline, f"not within {PATIENCE:g} s: {what}; {self.watch.ticks[-1].states}"
            time.sleep(0.005)
        return self.watch.ticks[-1]

    def wait_for_states(self, state: str) -> Tick:
        return self.wait(f"both arms are {state}", lambda tick: set(tick.states.values()) == {state})

    def press(self, hand: str) -> None:
        """The lower button, once."""
        self.lower = {hand}
        time.sleep(PRESS)
        self.lower = set()
        time.sleep(SETTLES)

    def press_twice(self, hand: str) -> None:
        for _ in range(2):
            self.lower = {hand}
            time.sleep(0.05)
            self.lower = set()
            time.sleep(0.06)
        time.sleep(SETTLES)

    def push(self, hand: str, analog: tuple[float, ...], until: str) -> Tick:
        """Push a trigger or the stick until both arms are in a state."""
        self.analog = {hand: analog}
        tick = self.wait_for_states(until)
        self.analog = {}
        time.sleep(SETTLES)
        return tick

    def engage(self) -> None:
        for hand in HANDS:
            while not self.watch.ticks[-1].engaged[hand]:
                self.press(hand)

    def move(self, *by: float) -> None:
        """Both hands, evenly."""
        start, way = self.shift, np.array(by)
        for share in np.linspace(0.0, 1.0, 60):
            self.shift = start + share * way
            time.sleep(1.0 / RATE_HZ)
        time.sleep(SETTLES)

    def _run(self) -> None:
        try:
            self.loop.run()
        except BaseException as failure:
            self.failure = failure

    def _stream(self) -> None:
        sensor = Sensor()
        with FakeHeadset(self.server.address) as headset:
            headset.send(headset.registrations())
            while not self._ended.wait(1.0 / RATE_HZ):
                headset.discard_received()
                for hand in HANDS:
                    x, y, z = START[hand] + self.shift
                    headset.send(headset.pose(hand, sensor.measured((x, y, z)), (0.0, 0.0, 0.0, 1.0)))
                    analog = self.analog.get(hand, (0.0,) * 4)
                    headset.send(headset.inputs(hand, lower=hand in self.lower, analog=analog))


@pytest.fixture
def cockpit() -> Iterator[Cockpit]:
    with Cockpit().running() as running:
        running.engage()
        running.move(0.06, 0.0, 0.06)
        yield running


def from_home(run: Cockpit, tick: Tick) -> float:
    return float(np.abs(tick.reference.q - run.loop.robot.home).max())


def test_the_way_home_that_a_hand_asks_for_ends_at_home(cockpit: Cockpit) -> None:
    assert from_home(cockpit, cockpit.watch.ticks[-1]) > 0.05
    cockpit.push("right", MIDDLE, until="homing")
    assert from_home(cockpit, cockpit.wait_for_states("paused")) < 0.005
    cockpit.engage()


def test_a_stop_holds_both_arms_until_it_is_taken_back(cockpit: Cockpit) -> None:
    cockpit.push("left", INDEX, until="stopped")
    cockpit.wait("both arms are at rest", lambda tick: float(np.abs(tick.reference.v).max()) < 1e-3)
    rest = cockpit.watch.ticks[-1].reference.q
    cockpit.press("left")
    cockpit.push("right", MIDDLE, until="stopped")  # the way home, which is not gone
    cockpit.move(0.0, 0.05, 0.0)
    tick = cockpit.wait_for_states("stopped")
    assert np.abs(tick.reference.q - rest).max() < 1e-3
    cockpit.push("right", INDEX, until="paused")
    cockpit.engage()


def test_hands_that_are_swapped_drive_the_other_arm(cockpit: Cockpit) -> None:
    for hand in HANDS:
        while cockpit.watch.ticks[-1].engaged[hand]:
            cockpit.press(hand)
    cockpit.wait_for_states("paused")
    while cockpit.loop.teleop.hand_of("right") != "left":  # a machine that stands still makes two taps of a double one
        for hand in HANDS:
            while cockpit.watch.ticks[-1].engaged[hand]:
                cockpit.press(hand)
        cockpit.press_twice("left")
    while not cockpit.watch.ticks[-1].engaged["right"]:
        cockpit.press("left")
    assert not cockpit.watch.ticks[-1].engaged["left"]
