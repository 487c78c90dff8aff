"""``tcp_endpoint``: the TCP server for the Quest2ROS app. ``CheckTCPconnection``: a live view of the hands' topics."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.live import Live

from q2r2_control.config.cell import HeadsetConfig
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.strict import network_of
from q2r2_control.errors import ConfigError
from q2r2_control.events import Reason
from q2r2_control.inputs.headset import HeadsetServer, watch_of
from q2r2_control.inputs.headset_check import SILENCE
from q2r2_control.inputs.listener import access_lines, written
from q2r2_control.inputs.messages import HandMessage, HandPose
from q2r2_control.inputs.samples import HandsWatch, Watched
from q2r2_control.inputs.session import HAND_TOPICS, TopicRecorder, TopicStatistics
from q2r2_control.ros.base_node import ERROR, OK, STEADY, WARN, BaseNode
from q2r2_control.ros.bridge.hand_topics import HandPublishers, subscribe_to_hands, subscribe_to_haptics
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import SIDES, HandFault
from q2r2_control.viewer.headset_table import topic_line, topic_table
from q2r2_control.wording import sentence

_TABLE_PERIOD, _LINES_PERIOD = 0.2, 1.0  # Times between two updates of the table, and between two reports in lines [s].
_SERVER_LOG = logging.getLogger("q2r2_control.inputs.headset")


class TcpEndpoint(BaseNode):
    """Serves one headset at a time. The thread that receives a message publishes it without a change.

    Poses are stamped with this node's clock when they are received, because the headset has a clock of its own. Poses
    that no arm may follow are left out, so that arms pause. These are frozen poses, and poses of a frame that moved.

    Raises:
        InputError: If host and port cannot be bound.
        ConfigError: If the value of ``allow`` is not allowed.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("tcp_endpoint", **kwargs)
        config = self.parameter("config", "", 'YAML of the cell, whose block headset counts; "": none')
        cell = load_config(config) if config else None
        headset = cell.headset if cell else HeadsetConfig()
        host = self.parameter("host", headset.host, "Address to listen on; 0.0.0.0 admits the network.")
        port = self.parameter("port", headset.port, "TCP port; 0 takes any free one.", within=(0, 65535))
        what = "Addresses and networks that may connect, by commas; empty: all."
        allow = self.parameter("allow", ",".join(headset.allow or ()), what)
        try:
            networks = tuple(network_of(text.strip()) for text in allow.split(",")) if allow.strip() else None
        except ValueError as error:
            raise ConfigError(f"parameter allow: {error}") from None
        self._frames = {
            hand: self.parameter(f"{hand}_frame_id", "", f"Frame of {hand} poses; empty: what the headset says.")
            for hand in SIDES
        }
        self._hand_publishers = HandPublishers(self)
        watch = watch_of(cell) if cell else HandsWatch()
        self._faults: dict[str, HandFault | None] = dict.fromkeys(SIDES)
        self._server = HeadsetServer(host, port, listener=self._publish, allow=networks, watch=watch)
        subscribe_to_haptics(self, self._server.send_haptic)
        self._log = logging.Handler()
        self._log.emit = self._pass_on  # type: ignore[method-assign]
        _SERVER_LOG.addHandler(self._log)
        _SERVER_LOG.setLevel(logging.INFO)
        self._server.start()
        self.get_logger().info(f"listening on {written(*self._server.address)}")
        for line in access_lines(*self._server.address, networks):
            self.get_logger().info(line)

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        statistics = self._server.statistics
        address = written(*statistics.address)
        values = {
            "address": address,
            "peer": statistics.peer,
            "dialect": statistics.dialect,
            "connections": statistics.connections,
            "last_disconnect": statistics.last_disconnect,
            "sent": self._hand_publishers.sent,
            "rate_hz": {name: topic.rate for name, topic in statistics.topics.items()},
            "unknown_topics": statistics.unknown_topics,
        }
        if statistics.peer is None:
            return WARN, f"no headset is connected to {address}", values
        if all(topic.age > SILENCE for topic in statistics.topics.values()):
            return WARN, f"{statistics.peer} is connected but sends no hand data", values
        return OK, f"{statistics.peer} is connected", values

    def close(self) -> None:
        self._server.close()
        _SERVER_LOG.removeHandler(self._log)

    def _publish(self, watched: Watched) -> None:
        reception, message = watched.reception, watched.reception.message
        if isinstance(message, HandPose):
            before, self._faults[reception.hand] = self._faults[reception.hand], watched.fault
            if watched.fault is not None:
                if before is not watched.fault:
                    why = sentence(Reason(TeleopReason(watched.fault)))
                    self.get_logger().warning(f"{reception.hand} hand: {why}; its poses are left out")
                return
        frame = self._frames[reception.hand] or (message.frame_id if isinstance(message, HandPose) else "")
        self._hand_publishers.publish(reception.topic, message, frame, self.now)

    def _pass_on(self, record: logging.LogRecord) -> None:
        # Each severity has a line of its own, because rclpy allows only one severity for each line of code.
        if record.levelno >= logging.WARNING:
            self.get_logger().warning(self._log.format(record))
        else:
            self.get_logger().info(self._log.format(record))


class CheckTcpConnection(BaseNode):
    """Shows pose, inputs and twist of both hands with rate and age, as a table on a terminal, or else in lines.

    A topic that is silent for 2 s has timed out. Ages are measured by the machine's steady clock, and not in ROS time.
    After ``duration`` the node ends, with exit code 1 if every topic has timed out.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("check_tcp_connection", **kwargs)
        duration = self.parameter("duration", 0.0, "Ends after this time; 0: on Ctrl-C [s].", within=(0.0, 86400.0))
        self._recorders: dict[str, TopicRecorder] = {}
        self._start, self._console = time.monotonic(), Console()
        self._live = Live(console=self._console, auto_refresh=False) if self._console.is_terminal else None
        if self._live is not None:
            self._live.start()
        subscribe_to_hands(self, self._hear)
        self.create_timer(_TABLE_PERIOD if self._live else _LINES_PERIOD, self._show, clock=STEADY)
        if duration > 0.0:
            self.create_timer(duration, self._finish, clock=STEADY)

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        topics, silent = self._topics()
        values = {name: topic.rate for name, topic in topics.items() if topic is not None}
        if not silent:
            return OK, "no timeout", {"rate_hz": values}
        level = ERROR if len(silent) == len(topics) else WARN
        return level, f"timeout, nothing for {SILENCE:g} s: {', '.join(silent)}", {"rate_hz": values}

    def close(self) -> None:
        if self._live is not None:
            self._live.stop()

    def _hear(self, topic: str, message: HandMessage) -> None:
        self._recorders.setdefault(topic, TopicRecorder()).record(message, time.monotonic())

    def _topics(self) -> tuple[dict[str, TopicStatistics | None], list[str]]:
        """Return the statistics of each topic, and the names of silent topics."""
        now, heard = time.monotonic(), self._recorders
        topics = {name: heard[name].snapshot(now) if name in heard else None for name in HAND_TOPICS}
        ages = {name: now - self._start if topic is None else topic.age for name, topic in topics.items()}
        return topics, [name for name, age in ages.items() if age > SILENCE]

    def _show(self) -> None:
        topics, silent = self._topics()
        if self._live is not None:
            title = f"timeout, nothing for {SILENCE:g} s" if len(silent) == len(topics) else "hands"
            self._live.update(topic_table(title, topics, silent), refresh=True)
            return
        for name, topic in topics.items():
            line = topic_line(name, topic, name in silent)
            self._console.print(line, soft_wrap=True, highlight=False, markup=False)

    def _finish(self) -> None:
        topics, silent = self._topics()
        self.exit_code = int(len(silent) == len(topics))
