"""``recorder``: writes what the nodes of a cell publish into one MCAP file for each run. It only listens.

It does not listen to topics with commands, because it would count as a receiver there. An arm without a controller
could then be engaged, and arms that are off their reference would be stopped. Instead, the nodes of arms publish their
targets a second time, and the controller publishes the reference of its commands. Streams arrive by best effort, so
that no sender waits for the recorder.
"""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from std_msgs.msg import String
from std_srvs.srv import Trigger

from q2r2_control.cameras.camera_streams import CameraStreams
from q2r2_control.config.bindings import Action
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import NOT_RECORDED, ConfigError
from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.judging.episode_judge import EpisodeJudge
from q2r2_control.process.program import program
from q2r2_control.recording.about import ROS, About, anonymous, as_yaml
from q2r2_control.recording.device_messages import DeviceMessages
from q2r2_control.recording.messages import (
    RECORDER_EVENTS,
    Message,
    Topic,
    arm_events,
    depth_topic,
    heard_on,
    is_latched,
    is_reliable,
    picture_topic,
    ros_topics,
)
from q2r2_control.recording.recorder import ROOM, ROOM_WITH_PICTURES, MessageRecorder
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.base_node import ERROR, LATCHED_QOS, OK, RECORDED_QOS, STEADY, WARN, BaseNode
from q2r2_control.ros.bridge.messages import age
from q2r2_control.teleop.both_arms import EpisodeMarks
from q2r2_control.teleop.reasons import REFUSALS, TeleopReason
from q2r2_control.wording import sentence

_SERVICES = {
    "start": TeleopReason.EPISODE_BEGINS,
    "stop": TeleopReason.EPISODE_ENDS,
    "discard": TeleopReason.EPISODE_DISCARDED,
    "success": TeleopReason.EPISODE_SUCCEEDED,
    "failure": TeleopReason.EPISODE_FAILED,
    "mark": TeleopReason.MARK,
    Action.NEXT_SUBTASK: TeleopReason.SUBTASK_BEGINS,
}
HANDOVER_PERIOD = 0.02  # New messages are passed on with this period. A message waits for two periods at most [s].
_STREAM_QOS = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)


class RecorderNode(BaseNode):
    """Writes one file, from the node's start to its end. The operator's controls and services mark episodes in it."""

    ticks = True

    def __init__(self) -> None:
        super().__init__("recorder")
        config = load_config(self.parameter("config", "config/dual_iiwa7.yaml", "YAML of the cell"))
        folder = self.parameter("folder", "recordings", "where each run gets a new folder")
        rate = self.parameter("rate", 250.0, "of the controller's loop, as it is set there [Hz]", within=(20, 1000))
        notes = {
            name: self.parameter(name, "", f"{what}, noted in the recording; empty: not")
            for name, what in (("task", "what is done"), ("operator", "whose hands"))
        }
        leaves_out = self.parameter("anonymous", False, "without the operator and the name of this computer")
        if not folder:
            raise ConfigError("parameter folder: empty; allowed: a folder")
        heard = {name: camera.topic for name, camera in config.cameras.items() if camera.topic is not None}
        streams = CameraStreams(config.device_cameras)
        room = ROOM_WITH_PICTURES if heard or config.device_cameras else ROOM
        # The process of the recorder starts while this process makes the node.
        self._recorder = MessageRecorder(Path(folder), config.name, room)
        self._judge = EpisodeJudge(lambda: self._recorder.file, self._tell, timed=False)
        robot = Robot.from_config(config)
        self._marks = EpisodeMarks()
        self._marks.subtasks = config.recording.subtasks
        self._served = 0
        self._served_last: Reason | None = None
        self._waiting: list[Message] = []
        self._events = self.create_publisher(String, self.name_in_set(RECORDER_EVENTS), RECORDED_QOS)
        depth = tuple(name for name, camera in config.device_cameras.items() if camera.depth)
        of_devices = {picture_topic(name) for name in config.device_cameras} | set(map(depth_topic, depth))
        topics = ros_topics(tuple(robot.arms), [*heard.values(), *sorted(of_devices)])
        self._begun, self._epoch, self._looked = time.monotonic_ns(), time.time_ns(), 0
        about = About(
            arms=tuple(robot.arms),
            joints=tuple(robot.joint_names),
            mode="",
            plant_modes=(),
            epoch=self._epoch,
            realtime=True,
            cell=as_yaml(config.model_copy(update={"loop_rate_hz": rate})),
            robot=robot.urdf,
            cameras=(*heard, *config.device_cameras),
            depth=depth,
            source=ROS,
            notes={**program(), **{name: text for name, text in notes.items() if text}},
        )
        if leaves_out:
            about = replace(about, notes=anonymous(about.notes))
        streams.wait_until_ready()
        channels = {topic.name: topic.channel for topic in topics}
        self._devices = DeviceMessages(streams, channels, self._unix_time_at, time.monotonic())
        self._recorder.begin(about, topics)
        taken = [topic for topic in topics if topic.name not in of_devices]
        self._listen(taken, {arm_events(arm) for arm in robot.arms}, heard.values())
        for name, kind in _SERVICES.items():
            self.create_service(Trigger, f"~/{name}", partial(self._serve, kind))
        self.create_tick(HANDOVER_PERIOD, self._write, clock=STEADY)
        self._marks.recorded = self._recorder.fault is None
        if self._marks.recorded:
            self.get_logger().info(f"records to {self._recorder.file}")

    def _listen(self, topics: Iterable[Topic], told: set[str], cameras: Collection[str]) -> None:
        for topic in topics:
            qos = LATCHED_QOS if is_latched(topic.name) else RECORDED_QOS if is_reliable(topic) else _STREAM_QOS
            take = partial(self._take, topic, topic.name in told)
            package, _, kind = topic.type.split("/")
            message = getattr(import_module(f"{package}.msg"), kind)
            name = topic.name if topic.name in cameras else self.name_in_set(heard_on(topic.name))
            self.create_subscription(message, name, take, qos, raw=True)

    def _take(self, topic: Topic, told: bool, payload: bytes, info: Mapping[str, Any]) -> None:
        """Keep a message until :meth:`_write`. ``told`` is True for an arm's event, which can be about an episode."""
        received = self._unix_time() - round(age(info) * 1e9)
        number, sent = info["publication_sequence_number"] or 0, info["source_timestamp"]
        self._waiting.append(Message(topic.channel, number, received, max(sent, 0), bytes(payload)))
        if told:
            text = deserialize_message(payload, String).data
            try:
                event = Event.from_json(json.loads(text))
            except (ValueError, TypeError, KeyError):  # The message is recorded, but no event can be read from it.
                self.drop(topic.name, f"{text!r:.60}")
                return
            self._marks.follow(event.kind)
            self._judge.record_event(self._event(event.reason))
            self.report_health()

    def _unix_time(self) -> int:
        """Return the Unix time [ns]. It does not jump if the computer's clock is set."""
        return self._epoch + time.monotonic_ns() - self._begun

    def _unix_time_at(self, monotonic: float) -> int:
        """Return the Unix time [ns] at a time of the monotonic clock [s]."""
        return self._epoch + round(monotonic * 1e9) - self._begun

    def _write(self) -> None:
        """Pass on the messages that were received before the previous call of this method, in the order of receipt.

        Newer messages wait until the next call. Topics are read one after the other, so an older message of another
        topic may not have been read yet.
        """
        pictures, reasons = self._devices.take(time.monotonic())
        self._waiting += pictures
        for reason in reasons:
            self.get_logger().warning(sentence(reason))
            self._tell(reason)
        until, self._looked = self._looked, self._unix_time()
        self._recorder.record([one for one in self._waiting if one.time <= until])
        self._waiting = [one for one in self._waiting if one.time > until]
        self._judge.report_verdicts()
        if self._marks.recorded and self._recorder.fault is not None:
            self._marks.recorded = False
            self.get_logger().error(f"nothing is recorded any more: {self._recorder.fault}")
            self._tell(Reason.of(TeleopReason.RECORDING_ENDED, text=self._recorder.fault))

    def _serve(self, kind: ReasonKind, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        refusal, reason = self._refusal(kind), Reason(kind)
        if refusal is None and kind is TeleopReason.SUBTASK_BEGINS:
            reason = self._marks.apply(Action.NEXT_SUBTASK)
            refusal = sentence(reason) if reason.kind in REFUSALS else None
        elif refusal is None:
            self._marks.follow(kind)
        response.success, response.message = refusal is None, refusal or sentence(reason)
        if refusal is None:
            self._judge.record_event(self._event(reason))
            self._tell(reason)
        return response

    def _event(self, reason: Reason) -> Event:
        return Event(self._unix_time() * 1e-9, "", "", "", reason)

    def _tell(self, reason: Reason) -> None:
        """Record an event that comes from no hand, and tell both hands of it through the arms' nodes."""
        self._served, self._served_last = self._served + 1, reason
        self._events.publish(String(data=json.dumps(self._event(reason).as_json())))
        self.report_health()

    def _refusal(self, kind: ReasonKind) -> str | None:
        if not self._marks.recorded:
            return f"{sentence(Reason(TeleopReason.NO_RECORDING))}: {self._recorder.fault}"
        if kind is TeleopReason.EPISODE_BEGINS and self._marks.open:
            return "an episode has begun and not ended"
        none_open = kind is TeleopReason.EPISODE_ENDS and not self._marks.open
        none_begun = kind is TeleopReason.EPISODE_DISCARDED and not self._marks.any
        return "no episode has begun" if none_open or none_begun else None

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        recorder = self._recorder
        values = {
            "file": "" if recorder.file is None else str(recorder.file),
            "messages": recorder.count,
            "lost_messages": recorder.overflows,
            **self._marks.as_json(),
            "served": self._served,
            "served_last": None if self._served_last is None else self._served_last.as_json(),
        }
        if recorder.fault is not None:
            return ERROR, f"nothing is recorded any more: {recorder.fault}", values
        if recorder.overflows:
            return WARN, f"{recorder.overflows} messages were lost: the disk is too slow", values
        return OK, f"records to {recorder.file}", values

    def close(self) -> None:
        """Write all messages, and report the result of the recording. If it is a failure, the exit code says so."""
        recorder = self._recorder
        self._judge.close()
        recorder.record([*self._waiting, *self._devices.take(time.monotonic())[0]])
        self._devices.streams.close()
        recorder.finish()
        if recorder.fault is not None:
            self.exit_code = NOT_RECORDED
        lost = recorder.count - recorder.written.messages
        if recorder.file is not None:
            written = f"{recorder.file}: {recorder.written.messages} messages"
            self.get_logger().info(written + (f", {lost} lost" if lost else ""))
