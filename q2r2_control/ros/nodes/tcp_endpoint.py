"""``tcp_endpoint``: the TCP server of the Quest2ROS app, between its connection and ROS topics.

Each message is published by the thread that receives it: polling would add its period, and drop twists.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from q2r2_control.config.cell import HeadsetConfig, load_config
from q2r2_control.config.strict import Network, network_of
from q2r2_control.config.teleop import GateSettings
from q2r2_control.errors import ConfigError
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.inputs.headset import HeadsetServer
from q2r2_control.inputs.headset_check import SILENCE
from q2r2_control.inputs.listener import access_lines, written
from q2r2_control.inputs.messages import HandPose
from q2r2_control.inputs.samples import HandsWatch, Watched
from q2r2_control.ros.base_node import OK, WARN, BaseNode
from q2r2_control.ros.bridge.hand_topics import HandPublishers, subscribe_to_haptics
from q2r2_control.types import SIDES, HandFault
from q2r2_control.wording import sentence

_SERVER_LOG = logging.getLogger("q2r2_control.inputs.headset")


class TcpEndpoint(BaseNode):
    """Serves one headset at a time. Numbers are passed on unchanged, and so is the frame unless one is configured.

    Poses are stamped with this node's clock when they are received, since the headset has a clock of its own. Poses
    that no arm may follow, frozen ones and those of a frame that moved, are left out, so that arms pause.

    Raises :class:`InputError` when host and port cannot be bound, :class:`ConfigError` for what ``allow`` cannot be.
    """

    priority = 37  # hands are heard as soon as scripted ones are sent; behind all that moves and stops arms

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("tcp_endpoint", **kwargs)
        config = self.parameter("config", "", 'YAML of the cell, whose block headset are defaults of these; "": none')
        cell = load_config(config) if config else None
        headset, gate = (cell.headset, cell.teleop.gate) if cell else (HeadsetConfig(), GateSettings())
        host = self.parameter("host", headset.host, "Address to listen on; 0.0.0.0 admits the network.")
        port = self.parameter("port", headset.port, "TCP port; 0 takes any free one.", within=(0, 65535))
        allow = self.parameter(
            "allow", ",".join(headset.allow or ()), "Addresses and networks that may connect, by commas; empty: all."
        )
        networks = _networks(allow)
        self._frames = {
            hand: self.parameter(f"{hand}_frame_id", "", f"Frame of {hand} poses; empty: what the headset says.")
            for hand in SIDES
        }
        self._hand_publishers = HandPublishers(self)
        frozen_time = self.parameter(
            "frozen_time",
            headset.frozen_time or 0.0,
            "Poses the same to the last bit for this long are left out [s]; 0: never.",
            within=(0.0, 10.0),
        )
        frame = self.parameter("watch_frame", headset.watch_frame, "Leave out poses of a frame that moved.")
        watch = HandsWatch(frozen_time or None, frame, gate.timeout)
        self._faults: dict[str, HandFault | None] = dict.fromkeys(SIDES)
        self._server = HeadsetServer(host, port, listener=self._publish, allow=networks, watch=watch)
        subscribe_to_haptics(self, self._server.send_haptic)
        self._log = _ToRosLog(self.get_logger())
        _SERVER_LOG.addHandler(self._log)
        _SERVER_LOG.setLevel(logging.INFO)
        self._server.start()
        self.get_logger().info(f"listening on {written(*self._server.address)}")
        for line in access_lines(*self._server.address, networks):
            self.get_logger().info(line)

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        """Which headset is connected, and the rate of each topic."""
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
        """Drop the headset and stop listening."""
        self._server.close()
        _SERVER_LOG.removeHandler(self._log)

    def _publish(self, watched: Watched) -> None:
        reception, message = watched.reception, watched.reception.message
        if isinstance(message, HandPose):
            before, self._faults[reception.hand] = self._faults[reception.hand], watched.fault
            if watched.fault is not None:
                if before is not watched.fault:
                    self.get_logger().warning(
                        f"{reception.hand} hand: {sentence(Reason(ReasonKind(watched.fault)))}; its poses are left out"
                    )
                return
        frame = self._frames[reception.hand] or (message.frame_id if isinstance(message, HandPose) else "")
        self._hand_publishers.publish(reception.topic, message, frame, self.now)


def _networks(allow: str) -> tuple[Network, ...] | None:
    try:
        return tuple(network_of(text.strip()) for text in allow.split(",")) if allow.strip() else None
    except ValueError as error:
        raise ConfigError(f"parameter allow: {error}") from None


class _ToRosLog(logging.Handler):
    """Passes the log of the server on to the log of the node."""

    def __init__(self, logger: Any) -> None:
        super().__init__()
        self._logger = logger

    def emit(self, record: logging.LogRecord) -> None:
        # rclpy allows one severity for each line of code.
        if record.levelno >= logging.WARNING:
            self._logger.warning(self.format(record))
        else:
            self._logger.info(self.format(record))
