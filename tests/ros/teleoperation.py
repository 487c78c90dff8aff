"""A whole teleoperation that tests kill and freeze nodes of, and what they ask of it afterwards.

Times are those of joint states received here, on the machine's steady clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from q2r2_control.config.timeouts import STREAM_TIMEOUT
from tests.ros.circling_operator import Operator
from tests.ros.joint_recorder import Stop
from tests.ros.processes import PATIENCE, skip_if_overloaded
from tests.ros.teleop_nodes import ARMS, TeleopNodes, address_of

BRAKING = 5.44  # lowest acceleration limit of a joint of the cell [rad/s^2]
# Allowance for messages, for processes to get their turn, and for an arm that is paused while its controller lives: it
# comes to rest at its last target, at 2 m/s^2 of the tool and not at the limits of the joints [s].
DELIVERY = 0.15
STILL = 0.005  # a joint that stands moves no farther [rad]
ANCHORED = 0.005  # a tool whose hand rests moves no farther [m]
# When hands move at 0.3 m/s the fastest joint turns at 0.9. Arms whose messages were late by the 0.15 s that pauses
# them catch up by that within the 0.2 s that speeds are means of [rad/s].
FAST = 1.7
AWHILE = 0.5  # in which something would have moved if anything did [s]

ENDPOINT = "tcp_endpoint"

Record = Callable[[str, object], None]
ATTEMPTS = 4  # to catch both arms in motion, and to measure while the machine is not overloaded
LONGEST_STARVED = 0.1  # time without joint states that is allowed for; a longer one makes a measurement void [s]


class Teleoperation:
    """The nodes and the operator."""

    def __init__(self, nodes: TeleopNodes, operator: Operator, port: int) -> None:
        self.nodes, self.operator, self._port = nodes, operator, port

    def restore(self, name: str) -> None:
        """Restart a node that was killed, continue one that is frozen."""
        self.nodes.restore(name, *([f"port:={self._port}"] if name == ENDPOINT else []))

    def press(self) -> None:
        """Engage both arms, each by its own hand; again if other load on the machine has looked like a fault."""
        self.nodes.reset_if_stopped()
        self.nodes.wait_until_ready()
        deadline = time.monotonic() + PATIENCE
        while paused := [arm for arm in ARMS if not self.nodes.engaged(arm)]:
            assert time.monotonic() < deadline, f"{paused} cannot be engaged: {self.nodes.diagnoses[-5:]}"
            self.nodes.reset_if_stopped()
            self.operator.press(*paused)
            time.sleep(0.1)

    def move(self) -> None:
        """Let both arms follow their hands at 0.3 m/s."""
        deadline = time.monotonic() + PATIENCE
        since: float | None = None
        while since is None or time.monotonic() - since < 0.3:
            if time.monotonic() > deadline:
                skip_if_overloaded("the arms are paused again and again")
                raise AssertionError(f"the arms do not follow: {self.nodes.diagnoses[-5:]}")
            if not all(map(self.nodes.engaged, ARMS)):
                self.press()
            self.operator.moves = True
            since = (since or time.monotonic()) if self.nodes.moving else None
            time.sleep(0.01)

    def move_again(self, name: str) -> None:
        """Restore a node, and let both arms follow again."""
        self.restore(name)
        self.operator.rest()
        self.move()

    def play(self) -> None:
        """Start the script until both arms follow; again if a fault stopped them early."""
        for _ in range(ATTEMPTS):
            self.nodes.reset_if_stopped()
            self.nodes.start("simulation_input")
            deadline = time.monotonic() + PATIENCE / 3.0
            while time.monotonic() < deadline:
                if self.nodes.moving:
                    time.sleep(0.3)  # until it is fast
                    return
                time.sleep(0.01)
            self.nodes.kill("simulation_input")
        skip_if_overloaded("the arms are paused again and again")
        raise AssertionError(f"the arms do not follow the script: {self.nodes.diagnoses[-5:]}")

    def measure_stop(self, what: str, fault: Callable[[], float], again: Callable[[], None], record: Record) -> Stop:
        """How both arms come to rest after a ``fault``, which may take them no longer than it has to.

        ``fault`` causes it and returns when that was. The measurement is void if the arms did not move at the fault,
        since the load of the machine had looked like another fault before, or if no joint states came for long, and
        a node that had no processor when it was to act is late without a trace in what comes here. Then ``again`` moves
        the arms once more: what is too slow is too slow each time.
        """
        for attempt in range(ATTEMPTS):
            if attempt:
                again()
            stop = self.nodes.joints.stop_after(fault())
            # The fault is noticed in a time that the arms may still get faster in.
            allowed = STREAM_TIMEOUT + stop.fastest / BRAKING + DELIVERY + 2.0 * stop.starved
            line = (
                f"from {stop.speed:.2f} rad/s, {stop.fastest:.2f} at most, slow within {1e3 * stop.slow:.0f} ms, "
                f"allowed {1e3 * allowed:.0f}, at rest within {1e3 * stop.rest:.0f} ms, allowed "
                f"{1e3 * (allowed + STREAM_TIMEOUT):.0f}; of which for an overloaded machine {2e3 * stop.starved:.0f}"
            )
            record(f"{what}, attempt {attempt + 1}", line)
            print(f"\n{what}: {line}")
            valid = stop.speed > 0.1 and stop.starved <= LONGEST_STARVED
            # The hand's data end first, then the targets.
            if valid and stop.slow <= allowed and stop.rest <= allowed + STREAM_TIMEOUT:
                assert self.nodes.joints.fastest(stop.fault) < FAST
                return stop
        skip_if_overloaded(line)
        raise AssertionError(f"{what}, the last of {ATTEMPTS}: {line}")

    def assert_only_a_press_moves(self, stop: Stop) -> None:
        """Nothing has moved since the stop; a press moves nothing either, but from then on the arms follow."""
        joints = self.nodes.joints
        self.nodes.wait_until_ready()
        time.sleep(AWHILE)
        assert joints.farthest_from(stop.posture, stop.t) < STILL
        self.operator.rest(stop.t)
        began = time.monotonic()
        self.press()
        time.sleep(AWHILE)
        assert joints.tool_farthest_from(stop.posture, began) < ANCHORED  # elbows may, towards their usual posture
        self.move()
        assert joints.fastest(began) < FAST


@contextmanager
def teleoperation(nodes: TeleopNodes, names: Sequence[str]) -> Iterator[Teleoperation]:
    """Start the nodes of these ``names`` and the endpoint of a headset, and connect the headset."""
    for name in names:
        nodes.start(name)
    address = address_of(nodes.start(ENDPOINT, "port:=0"))
    with Operator(address).streaming() as operator:
        yield Teleoperation(nodes, operator, address[1])
