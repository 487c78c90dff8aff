"""Publish the messages of a headset: ``SimulationInput`` from a scripted motion, ``hand_input`` from any input."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from q2r2_control.config.cell_file import load_config
from q2r2_control.inputs.base import make_input
from q2r2_control.inputs.messages import HandTwist, MessageType
from q2r2_control.inputs.scripted import FIRST_PRESS, START, TRAJECTORIES, ScriptedInput
from q2r2_control.ros.base_node import OK, WARN, BaseNode
from q2r2_control.ros.bridge.hand_topics import HandPublishers, subscribe_to_haptics
from q2r2_control.ros.monitoring import HandListeners
from q2r2_control.types import SIDES, HandSample

_PERIOD = 0.002  # Time between two polls of an input that is not a script [s].
_SHORTEST, _LONGEST = 0.001, 0.02  # Shortest and longest time between two checks for due samples [s].
# At the first of these times of the script, the node decides whether the buttons are pressed. At the second time, it
# decides whether the hands move [s].
_BEFORE_PRESS, _BEFORE_MOTION = FIRST_PRESS - 0.1, START - 0.05
# For this time after the first motion of the hands, an arm that stops is engaged again [s]. Other nodes can still be
# starting then.
_SETTLES = 6.0
# After ``_SETTLES``, an arm is engaged again only if it can be engaged within this time after it followed last [s]. A
# node that stood still works again within this time. A node that was killed counts as a second publisher for this time.
_RECOVERS = 3.0
_MODES = {
    "all": (MessageType.POSE, MessageType.INPUTS, MessageType.TWIST),
    "teleop": (MessageType.POSE, MessageType.INPUTS),
    "velocity": (MessageType.TWIST,),
}


class SimulationInput(BaseNode):
    """Plays a scripted trajectory, which presses and releases the lower buttons early to engage the arms.

    The script starts when every hand that it plays has a subscriber. The hands rest until the arms' nodes report that
    they can be engaged. Then the buttons are pressed. They are pressed again if an arm is not engaged when the hands
    would move, or if it stops in the first six seconds. After that time, they are pressed again only if arms stopped
    because a node stood still or data came late, and can be engaged again within three seconds. After any other stop,
    and after a request to pause, reset, stop or go home, only a person can engage an arm. A line in the log then says
    how. The script's own presses may still pause an arm.
    """

    ticks = True

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("simulation_input", **kwargs)
        side = self.parameter("side", "both", "Which hands move.", one_of=(*SIDES, "both"))
        what = "teleop: poses and inputs; velocity: twists; all: all three."
        mode = self.parameter("mode", "all", what, one_of=tuple(_MODES))
        trajectory = self.parameter("trajectory", "circle", "What the hands do.", one_of=tuple(TRAJECTORIES))
        rate = self.parameter("rate", 75.0, "Samples of each hand [Hz].", within=(1.0, 250.0))
        jitter = self.parameter("jitter", 0.0, "Samples come later by up to this, at random [s].", within=(0.0, 0.01))
        self._frame = self.parameter("frame_id", "", "Frame of the poses; a headset gives none.")
        self._waits_for_subscribers = True
        self._hands = SIDES if side == "both" else (side,)
        self._title, self._samples = f"{trajectory} of {' and '.join(self._hands)}", 0
        self._hand_publishers = HandPublishers(self, self._hands, _MODES[mode])
        self._make_script = partial(ScriptedInput, trajectory, self._hands, rate_hz=rate, jitter=jitter)
        self._listeners = HandListeners(self, self._hands if MessageType.INPUTS in _MODES[mode] else ())
        self._starts = True  # Whether presses may still engage the arms.
        self._pressed = False  # Whether the buttons were pressed once to engage the arms.
        self._moves = False  # Whether the hands move.
        # Until this time, arms are engaged again after any stop except a request [s].
        self._until = math.inf
        self._followed = -math.inf  # Time at which all arms followed last [s].
        # How a person can engage the arms; None while the script may still press, or while no arm is lost.
        self._advice: str | None = None
        self._not_to_press: set[str] | None = None  # Hands that do not press; None if that is not decided yet.
        self._rewind(self.now)
        self._timer = self.create_tick(_LONGEST, self._tick)

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        missing = self._missing() if self._waits_for_subscribers else []
        values = {"samples": self._samples, "sent": self._hand_publishers.sent, "without_subscriber": missing}
        if self._waits_for_subscribers:
            return WARN, f"waits for a subscriber of the {' and the '.join(missing)} hand", values
        if self._starts and (unready := self._listeners.unready()) is not None:
            return WARN, f"waits: {unready}", values
        if self._advice is not None:
            return WARN, self._advice, values
        return OK, self._title, values

    def _missing(self) -> list[str]:
        """Return the hands without a subscriber."""
        return [hand for hand in self._hands if not self._hand_publishers.subscribers(hand)]

    def _tick(self) -> None:
        """Play the script, and schedule the next tick for the next sample."""
        if self._waits_for_subscribers:
            if self._missing():
                return
            self._waits_for_subscribers = False
            self._rewind(self.now)  # The script begins now.
            self.get_logger().info(f"plays {self._title}")
        now = self.now
        following = [hand for hand in self._hands if self._listeners.engaged(hand) is not False]
        if len(following) == len(self._hands):
            self._followed = now
        if self._starts:
            self._engage(now, following)
        self._advise(now)
        for sample in self._script.poll(now):
            self._publish(sample, following)
        wait = min(max(self._script.due() - self.now, _SHORTEST), _LONGEST)
        self._timer.timer_period_ns = int(1e9 * wait)
        self._timer.reset()

    def _engage(self, now: float, following: Sequence[str]) -> None:
        """Restart the script until the arms are ready, and then until they follow.

        At the beginning of the script, the hands rest.
        """
        if now <= self._until:
            self._listeners.look()  # Later, the arms are known, and the graph need not be asked any more.
        t = now - self._began
        # The last event of an arm can be a request before the first press. Such a request does not count.
        self._pressed = self._pressed or (self._not_to_press is not None and t >= _BEFORE_MOTION)
        all_follow = len(following) == len(self._hands)
        recovers = all_follow or (now - self._followed <= _RECOVERS and bool(self._listeners.lost()))
        if not self._pressed:
            self._listeners.begin()
        elif self._listeners.asked_to_hold() or not (recovers or now <= self._until):
            self._starts = False
            if not self._moves:
                self._not_to_press = set(self._hands)
            return
        if t < _BEFORE_PRESS or (self._not_to_press is not None and t < _BEFORE_MOTION):
            return
        may_press = now <= self._until or self._listeners.only_late()
        if self._not_to_press is None:
            if may_press and self._listeners.unready() is None:
                # A press would pause arms that are engaged already.
                self._not_to_press = {hand for hand in following if self._listeners.engaged(hand)}
            else:
                self._rewind(now)
        elif all_follow or (self._moves and following):
            # While an arm follows, moving hands do not go back to the start, because that would be a jump.
            self._moves, self._until = True, min(self._until, now + _SETTLES)
        elif may_press:
            self._rewind(now)

    def _advise(self, now: float) -> None:
        """Log one line if the script presses no more and arms stay stopped."""
        lost = {} if self._starts else self._listeners.lost()
        if not lost:
            self._advice = None
        elif self._advice is None and now - self._followed > _RECOVERS:
            arms = ", ".join(f"{name}: {message}" for name, message in lost.items())
            calls = " and ".join(f"{name}/engage" for name in lost)
            self._advice = f"presses no more; call {calls}, or end all nodes and start them again ({arms})"
            self.get_logger().warning(self._advice)

    def _rewind(self, now: float) -> None:
        self._script = self._make_script()
        self._script.start()
        self._began, self._not_to_press, self._moves = now, None, False

    def _publish(self, sample: HandSample, following: Sequence[str]) -> None:
        would_engage = (self._moves or not self._starts) and sample.hand not in following
        if would_engage or (not self._moves and sample.hand in (self._not_to_press or ())):
            sample = replace(sample, inputs=replace(sample.inputs, button_lower=False))
        self._hand_publishers.publish_sample(sample, self._frame, partial(self._twist, sample))
        self._samples += 1

    def _twist(self, sample: HandSample) -> HandTwist:
        twist = self._script.hand_twist(sample.hand, sample.pose_stamp)
        return HandTwist(twist.linear, twist.angular)


class HandInput(BaseNode):
    """Polls an input and publishes each sample. A pose with a fault is left out, so that its arm pauses.

    Raises:
        ConfigError: If the input or a control is unknown.
    """

    ticks = True

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("hand_input", **kwargs)
        config = load_config(self.parameter("config", "config/dual_iiwa7.yaml", "YAML of the cell"))
        name = self.parameter("input", config.input, "An installed input.")
        self._input = make_input(name, config)
        config.teleop.bindings.check_device(self._input.controls)
        self._title, self._samples = name, 0
        self._hand_publishers = HandPublishers(self, kinds=(MessageType.POSE, MessageType.INPUTS))
        subscribe_to_haptics(self, self._input.send_haptic)
        self._input.start()
        self.create_timer(_PERIOD, self._tick)

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        values = {"samples": self._samples, "sent": self._hand_publishers.sent}
        connected = self._input.connected
        return OK if connected else WARN, self._title if connected else f"{self._title} is not connected", values

    def close(self) -> None:
        self._input.close()

    def _tick(self) -> None:
        for sample in self._input.poll(self.now):
            self._hand_publishers.publish_sample(sample)
            self._samples += 1
