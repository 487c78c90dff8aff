"""A fake Quest2ROS headset. It sends the app's bytes over TCP, in the dialects of ROS 1 and ROS 2.

This file packs the bytes without the code under test. Run as a program, it engages both arms of a running server, and
moves both hands in circles:

    python -m tests.support.fake_headset --port 10000 --duration 20
"""

from __future__ import annotations

import argparse
import json
import random
import socket
import struct
import sys
import time
from contextlib import suppress
from typing import Any

from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.quaternions import Quaternion, Vector
from q2r2_control.types import SIDES

RATE_HZ = 75.0
DIALECTS = ("ros1", "ros2")
KEEPALIVE = b"\0\0\0\0\0\0\0\0"
TOPICS = {"pose": "geometry_msgs/PoseStamped", "twist": "geometry_msgs/Twist", "inputs": "quest2ros/OVR2ROSInputs"}
NOISE = 1e-6  # Noise of a position [m]. It is so small that it only distinguishes a hand at rest from a frozen pose.


class FakeHeadset:
    """A connection of a headset. With ``slash``, topics have a leading slash; ``source`` is the headset's address."""

    def __init__(
        self,
        address: tuple[str, int],
        dialect: str = "ros2",
        slash: bool = False,
        connect_timeout: float = 5.0,
        source: str = "",
    ) -> None:
        self.dialect = dialect
        self._slash = "/" if slash else ""
        self._received = bytearray()
        deadline, here = time.monotonic() + connect_timeout, (source, 0) if source else None
        while True:  # Like the app, the headset tries again while no server listens.
            try:
                self.socket = socket.create_connection(address, timeout=None, source_address=here)
                break
            except ConnectionRefusedError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.05)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def frame(self, destination: str, payload: bytes) -> bytes:
        """Return a frame as this dialect's client writes it."""
        name = destination.encode() + (b"\0" if self.dialect == "ros2" else b"")
        return struct.pack(f"<I{len(name)}sI", len(name), name, len(payload)) + payload

    def command(self, name: str, **parameters: object) -> bytes:
        """Return a system command. In the ROS 2 dialect, its JSON ends with NUL."""
        text = json.dumps(parameters, separators=(",", ":")).encode()
        return self.frame(name, text + (b"\0" if self.dialect == "ros2" else b""))

    def topic(self, hand: str, suffix: str) -> str:
        return f"{self._slash}q2r_{hand}_hand_{suffix}"

    def registrations(self) -> bytes:
        """Return the app's first messages after connecting: a keepalive, its topics, and a request for topics."""
        parts = [KEEPALIVE]
        for hand in SIDES:
            for suffix, kind in TOPICS.items():
                topic = self.topic(hand, suffix)
                parts.append(self.command("__publish", topic=topic, message_name=kind, queue_size=10, latch=False))
            haptic = {"topic": self.topic(hand, "haptic_feedback"), "message_name": "quest2ros/OVR2ROSHapticFeedback"}
            parts.append(self.command("__subscribe", **haptic))
        return b"".join([*parts, self.command("__topic_list")])

    def pose(self, hand: str, *values: Any, **options: Any) -> bytes:
        """See :func:`pack_pose`."""
        return self.frame(self.topic(hand, "pose"), pack_pose(self.dialect, *values, **options))

    def twist(self, hand: str, linear: Vector, angular: Vector) -> bytes:
        return self.frame(self.topic(hand, "twist"), pack_twist(self.dialect, linear, angular))

    def inputs(self, hand: str, *values: Any, **options: Any) -> bytes:
        """See :func:`pack_inputs`."""
        return self.frame(self.topic(hand, "inputs"), pack_inputs(self.dialect, *values, **options))

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def read_frame(self, timeout: float = 5.0) -> tuple[str, bytes] | None:
        """Return the next frame from the server that is no keepalive, or None at the end. Raises TimeoutError."""
        deadline = time.monotonic() + timeout
        while True:
            frame = self._cut_frame()
            if frame == ("", b""):
                continue
            if frame is not None:
                return frame
            self.socket.settimeout(max(deadline - time.monotonic(), 0.001))
            try:
                data = self.socket.recv(1 << 16)
            except ConnectionError:
                return None
            finally:
                self.socket.settimeout(None)
            if not data:
                return None
            self._received += data

    def read_until(self, destination: str, timeout: float = 5.0) -> bytes:
        """Return the payload of the next frame with ``destination``. Raises TimeoutError or ConnectionError."""
        deadline = time.monotonic() + timeout
        while (frame := self.read_frame(max(deadline - time.monotonic(), 0.001))) is not None:
            if frame[0] == destination:
                return frame[1]
        raise ConnectionError(f"the server closed before it sent {destination}")

    def discard_received(self) -> None:
        """Discard what the server has sent so far."""
        self._received.clear()
        with suppress(BlockingIOError):
            while self.socket.recv(1 << 16, socket.MSG_DONTWAIT):
                pass

    def reset(self) -> None:
        """End the connection by a TCP reset instead of closing it."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.socket.close()

    def close(self) -> None:
        self.socket.close()

    def __enter__(self) -> FakeHeadset:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _cut_frame(self) -> tuple[str, bytes] | None:
        buffer, starts = self._received, 8
        if len(buffer) >= starts:
            starts += struct.unpack_from("<I", buffer)[0]
        if len(buffer) < starts:
            return None
        end = starts + struct.unpack_from("<I", buffer, starts - 4)[0]
        if len(buffer) < end:
            return None
        frame = (buffer[4 : starts - 4].decode(), bytes(buffer[starts:end]))
        del buffer[:end]
        return frame


def pack_pose(
    dialect: str, position: Vector, quaternion: Quaternion, frame_id: str = "", stamp: tuple[int, int] = (12, 500)
) -> bytes:
    """Return the bytes of a pose; ``stamp`` is a time of the headset's own clock, as seconds and nanoseconds."""
    numbers = struct.pack("<7d", *position, *quaternion)
    name = frame_id.encode()
    if dialect == "ros1":
        return struct.pack("<IiII", 7, *stamp, len(name)) + name + numbers
    text = struct.pack("<iII", *stamp, len(name) + 1) + name + b"\0"
    return b"\0\1\0\0" + text + b"\0" * (-len(text) % 8) + numbers


def pack_twist(dialect: str, linear: Vector, angular: Vector) -> bytes:
    return (b"\0\1\0\0" if dialect == "ros2" else b"") + struct.pack("<6d", *linear, *angular)


def pack_inputs(
    dialect: str, upper: bool = False, lower: bool = False, analog: tuple[float, ...] = (0.0,) * 4
) -> bytes:
    if dialect == "ros1":
        return struct.pack("<??4f", upper, lower, *analog)
    return b"\0\1\0\0" + struct.pack("<??2x4f", upper, lower, *analog)


def main() -> int:
    """Send the motion of scripted hands to a server, at RATE_HZ in real time. The server may close the connection."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--duration", type=float, default=20.0, help="[s]")
    arguments = parser.parse_args()
    script, noise = ScriptedInput("circle", rate_hz=RATE_HZ), random.Random(0)
    script.start()
    with suppress(ConnectionError), FakeHeadset(("127.0.0.1", arguments.port), connect_timeout=30.0) as headset:
        headset.send(headset.registrations())
        start = time.monotonic()
        for index in range(int(arguments.duration * RATE_HZ)):
            time.sleep(max(start + index / RATE_HZ - time.monotonic(), 0.0))
            headset.discard_received()
            for sample in script.poll(index / RATE_HZ):
                x, y, z = (value + noise.gauss(0.0, NOISE) for value in sample.position.tolist())
                headset.send(headset.pose(sample.hand, (x, y, z), sample.quaternion.tolist()))
                headset.send(headset.inputs(sample.hand, lower=sample.inputs.button_lower))
    return 0


if __name__ == "__main__":
    sys.exit(main())
