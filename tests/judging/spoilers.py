"""Functions that spoil a copy of a recorded episode, by faults that real recorders, cameras and cables have."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np
from PIL import Image

from q2r2_control.recording import messages as names
from q2r2_control.recording.about import About
from q2r2_control.recording.bag import BagWriter
from q2r2_control.recording.messages import NANOSECONDS, Message, array, data_of, numbers_of, picture, picture_topic
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.tick_rows import Rows, numbers_in, tick_type

LATE = 0.2  # Delay that these functions give to data [s].


@dataclass
class Contents:
    """All messages of a recording, by topic, and its ticks as rows."""

    recording: Recording
    about: About
    messages: dict[str, list[Message]]
    rows: Rows

    @classmethod
    def of(cls, file: Path) -> Contents:
        recording = Recording(file)
        found: dict[str, list[Message]] = {topic.name: [] for topic in recording.declared_topics.values()}
        for some in recording.messages():
            for message in some:
                found[recording.declared_topics[message.channel].name].append(message)
        about = recording.about
        kind = tick_type(len(about.arms), len(about.joints))
        numbers = numbers_of([message.payload for message in found[names.TICK]], kind.itemsize // 8)
        return cls(recording, about, found, numbers.reshape(-1).view(kind).copy())

    def write(self, target: Path) -> Path:
        """Write the contents as a recording that was closed properly."""
        rows = zip(self.messages[names.TICK], numbers_in(self.rows), strict=True)
        self.messages[names.TICK] = [message._replace(payload=array(numbers)) for message, numbers in rows]
        every = sorted((one for found in self.messages.values() for one in found), key=lambda one: one.time)
        with BagWriter(target, self.recording.declared_topics.values(), self.about) as bag:
            for _, some in groupby(every, key=lambda message: message.number // 200):
                bag.write(some)
                bag.flush()
            bag.close(self.recording.conclusion)
        return target

    @property
    def middle(self) -> slice:
        """Return the rows of 100 ticks in the middle of the episode, while the arms move."""
        return slice(len(self.rows) // 2, len(self.rows) // 2 + 100)

    @property
    def ticks_late(self) -> int:
        return round(LATE / float(self.rows["dt"].mean()))

    def pictures(self, camera: str) -> list[Message]:
        return self.messages[picture_topic(camera)]

    def change_pictures(self, camera: str, change: Callable[[int, bytes], bytes]) -> None:
        """Replace each picture by the result of ``change`` for its number and its JPEG."""
        changed = self.messages[picture_topic(camera)] = [
            one._replace(payload=picture(camera, one.time, change(number, jpeg_in(one))))
            for number, one in enumerate(self.pictures(camera))
        ]
        assert changed

    def keep_pictures(self, camera: str, keep: Callable[[int], bool]) -> None:
        found = self.pictures(camera)
        self.messages[picture_topic(camera)] = [one for number, one in enumerate(found) if keep(number)]


def jpeg_in(message: Message) -> bytes:
    return bytes(data_of(message.payload, names.PICTURE))


Spoiler = Callable[[Contents], object]


def frozen(contents: Contents) -> None:
    found = list(map(jpeg_in, contents.pictures("left_wrist")))
    contents.change_pictures("left_wrist", lambda number, jpeg: found[min(number, len(found) // 2)])


def late_pictures(contents: Contents) -> None:
    """Let each picture show the cell as it was 200 ms before the picture's stamp."""
    found = contents.pictures("left_wrist")
    seen = np.array([message.time for message in found])
    shown = [jpeg_in(found[max(int(np.searchsorted(seen, time - LATE * NANOSECONDS)) - 1, 0)]) for time in seen]
    contents.change_pictures("left_wrist", lambda number, jpeg: shown[number])


def black(contents: Contents) -> None:
    contents.change_pictures("above", lambda number, jpeg: drawn_again(jpeg, lambda pixels: 0 * pixels))


def black_for_a_while(contents: Contents) -> None:
    contents.change_pictures(
        "above", lambda number, jpeg: drawn_again(jpeg, lambda pixels: 0 * pixels) if number % 60 > 50 else jpeg
    )


def swapped(one: str, two: str) -> Spoiler:
    def spoil(contents: Contents) -> None:
        first, second = (list(map(jpeg_in, contents.pictures(camera))) for camera in (one, two))
        contents.change_pictures(one, lambda number, jpeg: second[number])
        contents.change_pictures(two, lambda number, jpeg: first[number])

    return spoil


def cut_jpeg(contents: Contents) -> None:
    contents.change_pictures("above", lambda number, jpeg: jpeg[: len(jpeg) // 2] if number == 20 else jpeg)


def overwritten_jpeg(contents: Contents) -> None:
    random = np.random.default_rng(0)

    def overwrite(number: int, jpeg: bytes) -> bytes:
        if number != 20:
            return jpeg
        begin = len(jpeg) // 2
        return jpeg[:begin] + random.bytes(400) + jpeg[begin + 400 :]

    contents.change_pictures("above", overwrite)


def zeros_in_jpeg(contents: Contents) -> None:
    def overwrite(number: int, jpeg: bytes) -> bytes:
        begin = len(jpeg) // 2
        return jpeg[:begin] + bytes(400) + jpeg[begin + 400 :] if number == 20 else jpeg

    contents.change_pictures("above", overwrite)


def no_jpeg(contents: Contents) -> None:
    contents.change_pictures("above", lambda number, jpeg: b"no picture" if number == 20 else jpeg)


def other_size(contents: Contents) -> None:
    contents.change_pictures("above", lambda number, jpeg: drawn_again(jpeg, lambda pixels: pixels[:-8]))


def drawn_again(jpeg: bytes, change: Callable[[np.ndarray], np.ndarray]) -> bytes:
    packed = io.BytesIO()
    Image.fromarray(change(np.asarray(Image.open(io.BytesIO(jpeg))))).save(packed, "JPEG")
    return packed.getvalue()


def half_rate(contents: Contents) -> None:
    contents.keep_pictures("right_wrist", lambda number: number % 2 == 0)


def no_pictures(contents: Contents) -> None:
    contents.keep_pictures("right_wrist", lambda number: False)


def stops_half_way(contents: Contents) -> None:
    half = len(contents.pictures("right_wrist")) // 2
    contents.keep_pictures("right_wrist", lambda number: number < half)


def not_measured(contents: Contents) -> None:
    contents.rows["q"][contents.middle, 3] = np.nan


def not_measured_velocity(contents: Contents) -> None:
    contents.rows["v"][contents.middle, 3] = np.inf


def no_reference(contents: Contents) -> None:
    contents.rows["reference_v"][contents.middle, 3] = np.nan


def spikes(contents: Contents) -> None:
    for tick in range(contents.middle.start, contents.middle.stop, 20):
        contents.rows["q"][tick, 3] += 0.3


def one_spike(contents: Contents) -> None:
    contents.rows["q"][contents.middle.start, 10] -= 0.1


def too_fast(contents: Contents) -> None:
    """Let the measured position of a joint deviate and return without a jump, at several times its speed limit."""
    ticks = np.arange(len(contents.rows))
    contents.rows["q"][:, 3] += 0.6 * np.exp(-0.5 * ((ticks - contents.middle.start) / (20.0)) ** 2)


def wrong_sign(contents: Contents) -> None:
    contents.rows["v"] *= -1.0


def wrong_unit(contents: Contents) -> None:
    contents.rows["v"] = np.degrees(contents.rows["v"])


def late_reference(contents: Contents) -> None:
    late = contents.ticks_late
    for name in ("reference_q", "reference_v", "reference_a"):
        contents.rows[name][late:] = contents.rows[name][:-late].copy()
        contents.rows[name][:late] = contents.rows[name][0]
    contents.rows["arms"]["tool"][late:] = contents.rows["arms"]["tool"][:-late].copy()


def late_measured(contents: Contents) -> None:
    late = contents.ticks_late
    contents.rows["q"][late:] = contents.rows["q"][:-late].copy()
    contents.rows["v"][late:] = contents.rows["v"][:-late].copy()


def repeated_stamps(contents: Contents) -> None:
    ticks = contents.messages[names.TICK]
    for tick in range(contents.middle.start, contents.middle.stop, 2):
        ticks[tick + 1] = ticks[tick + 1]._replace(time=ticks[tick].time)


def repeated_times(contents: Contents) -> None:
    now = contents.rows["now"]
    now[contents.middle.start + 1 : contents.middle.stop] = now[contents.middle.start]


def constant_gripper(contents: Contents) -> None:
    for name in ("wanted", "commanded", "opening"):
        contents.rows["arms"][name] = 1.0
    retitled(contents, "pick up the block and stack it")


def stuck_gripper(contents: Contents) -> None:
    contents.rows["arms"]["opening"] = contents.rows["arms"]["opening"][0]


def two_runs(contents: Contents) -> None:
    contents.rows["following"][contents.middle] = 0.0


def empty(topic: str) -> Spoiler:
    return lambda contents: contents.messages[topic].clear()


def retitled(contents: Contents, task: str) -> None:
    contents.about = replace(contents.about, notes={**contents.about.notes, "task": task})


def without_ticks(contents: Contents) -> None:
    contents.messages[names.TICK].clear()
    contents.rows = contents.rows[:0]


CAMERAS: dict[str, tuple[Spoiler, str]] = {
    "a picture that is frozen from half-way on": (frozen, "max_frozen_share"),
    "pictures that are 200 ms late": (late_pictures, "max_picture_lag"),
    "black pictures": (black, "max_black_share"),
    "some black pictures": (black_for_a_while, "max_black_share"),
    "two swapped cameras on arms": (swapped("left_wrist", "right_wrist"), "swapped_cameras"),
    "a fixed camera and one on an arm that are swapped": (swapped("above", "left_wrist"), "swapped_cameras"),
    "half the rate": (half_rate, "min_picture_rate_share"),
    "no picture at all": (no_pictures, "min_picture_rate_share"),
    "pictures that stop half-way": (stops_half_way, "max_picture_gap"),
    "a JPEG that is cut": (cut_jpeg, "max_bad_pictures"),
    "a JPEG that is overwritten": (overwritten_jpeg, "max_bad_pictures"),
    "a JPEG with a page of zeros": (zeros_in_jpeg, "max_bad_pictures"),
    "a picture that is no JPEG": (no_jpeg, "max_bad_pictures"),
    "pictures of another size": (other_size, "max_bad_pictures"),
}

NUMBERS: dict[str, tuple[Spoiler, str]] = {
    "positions that are NaN": (not_measured, "max_unmeasured_ticks"),
    "a reference that is NaN": (no_reference, "max_unmeasured_ticks"),
    "velocities that are infinite": (not_measured_velocity, "max_unmeasured_ticks"),
    "spikes of 0.3 rad": (spikes, "max_joint_speed"),
    "one spike of 0.1 rad": (one_spike, "max_joint_speed"),
    "a joint that is faster than it can be": (too_fast, "max_joint_speed"),
    "velocities of the wrong sign": (wrong_sign, "max_velocity_mismatch"),
    "velocities in degrees": (wrong_unit, "max_velocity_mismatch"),
    "a reference that is 200 ms late": (late_reference, "max_reference_lag"),
    "measured joints that are 200 ms late": (late_measured, "max_reference_lag"),
    "repeated stamps of messages": (repeated_stamps, "repeated_stamps"),
    "repeated times of ticks": (repeated_times, "repeated_stamps"),
    "a gripper that does nothing while it should grasp": (constant_gripper, "constant_gripper"),
    "a gripper that is stuck": (stuck_gripper, "stuck_gripper"),
    "two runs in one file": (two_runs, "begins_again"),
    "no joint states": (empty(names.JOINT_STATES), "empty_topics"),
    "no commands": (empty(names.JOINT_COMMANDS), "empty_topics"),
    "no state": (empty(names.STATE), "empty_topics"),
    "no targets": (empty(names.target("left")), "empty_topics"),
    "no hand poses": (empty(names.hand_pose("right")), "empty_topics"),
    "no hand samples": (empty(names.SAMPLES), "min_pose_rate"),
    "no ticks": (without_ticks, "no_ticks"),
    "an empty task": (lambda contents: retitled(contents, " "), "empty_task"),
}


def spoiled(file: Path, target: Path, *spoilers: Spoiler) -> Path:
    contents = Contents.of(file)
    for spoil in spoilers:
        spoil(contents)
    return contents.write(target)
