"""``CheckTCPconnection``: a live view of the data of both hands."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from rclpy.clock import Clock, ClockType
from rich.console import Console
from rich.live import Live

from q2r2_control.inputs.headset_check import SILENCE
from q2r2_control.inputs.messages import HandMessage
from q2r2_control.inputs.session import HAND_TOPICS, TopicRecorder, TopicStatistics
from q2r2_control.ros.base_node import ERROR, OK, WARN, BaseNode
from q2r2_control.ros.bridge.hand_topics import subscribe_to_hands
from q2r2_control.viewer.headset_table import topic_line, topic_table

_TABLE_PERIOD = 0.2  # [s]
_LINES_PERIOD = 1.0  # [s]


class CheckTcpConnection(BaseNode):
    """Shows pose, inputs and twist of both hands with rate and age: a table on a terminal, else a line a topic.

    A topic that is silent for 2 s has timed out. Ages are measured with the machine's steady clock, not in ROS time.
    After ``duration`` it ends, with exit code 1 when every topic has timed out.
    """

    def __init__(self, console: Console | None = None, **kwargs: Any) -> None:
        super().__init__("check_tcp_connection", **kwargs)
        duration = self.parameter("duration", 0.0, "Ends after this time; 0: on Ctrl-C [s].", within=(0.0, 86400.0))
        self._recorders: dict[str, TopicRecorder] = {}
        self._start = time.monotonic()
        self._console = console = console or Console()
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        if self._live is not None:
            self._live.start()
        subscribe_to_hands(self, self._hear)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_TABLE_PERIOD if self._live else _LINES_PERIOD, self._show, clock=steady)
        if duration > 0.0:
            self.create_timer(duration, self._finish, clock=steady)

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        """Which topics have timed out."""
        topics = self._topics()
        silent = self._silent(topics)
        values = {name: topic.rate for name, topic in topics.items() if topic is not None}
        if not silent:
            return OK, "no timeout", {"rate_hz": values}
        level = ERROR if len(silent) == len(topics) else WARN
        return level, f"timeout, nothing for {SILENCE:g} s: {', '.join(silent)}", {"rate_hz": values}

    def close(self) -> None:
        """Release the terminal; the last table stays."""
        if self._live is not None:
            self._live.stop()

    def _hear(self, topic: str, message: HandMessage) -> None:
        self._recorders.setdefault(topic, TopicRecorder()).record(message, time.monotonic())

    def _topics(self) -> dict[str, TopicStatistics | None]:
        now = time.monotonic()
        return {name: self._recorders[name].snapshot(now) if name in self._recorders else None for name in HAND_TOPICS}

    def _silent(self, topics: Mapping[str, TopicStatistics | None]) -> list[str]:
        running = time.monotonic() - self._start
        return [name for name, topic in topics.items() if (running if topic is None else topic.age) > SILENCE]

    def _show(self) -> None:
        topics = self._topics()
        silent = self._silent(topics)
        if self._live is not None:
            title = f"timeout, nothing for {SILENCE:g} s" if len(silent) == len(topics) else "hands"
            self._live.update(topic_table(title, topics, silent), refresh=True)
            return
        for name, topic in topics.items():
            line = topic_line(name, topic, name in silent)
            self._console.print(line, soft_wrap=True, highlight=False, markup=False)

    def _finish(self) -> None:
        topics = self._topics()
        self.exit_code = int(len(self._silent(topics)) == len(topics))
