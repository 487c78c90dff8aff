"""The types of the JSON that a run sends to the page. The types for the page's scripts are made from these classes.

Poses are x y z qx qy qz qw in the world, in metres, and points are x y z. Colours are r g b, from 0 to 255.
"""

from __future__ import annotations

from typing import NotRequired

from typing_extensions import TypedDict

Colour = tuple[int, int, int]
Seven = tuple[float, float, float, float, float, float, float]
Point = tuple[float, float, float]


class ShownMesh(TypedDict):
    """A mesh in the frame of a joint."""

    joint: int
    colour: Colour
    vertices: list[float]
    faces: list[int]


class ShownPart(TypedDict):
    """A loose part, drawn as a box."""

    size: Point
    colour: Colour


class ShownScene(TypedDict):
    """The part of a run that does not change."""

    name: str
    meshes: list[ShownMesh]
    hands: dict[str, list[int]]  # Joints that move with the tool, by arm.
    parts: dict[str, ShownPart]
    floor: float  # [m]
    timeout: float  # An arm stops if no hand comes for this time [s].


class ShownArm(TypedDict):
    """An arm. In ``why`` and ``next``, a control has its name in braces, since only the page knows the device.

    ``hand`` is the hand that drives the arm, ``colour`` is that of the state, and ``silent`` says that the arm stopped
    because the data of its hand did not come in time.
    """

    state: str
    colour: Colour
    why: str
    next: str
    hand: str
    silent: bool
    tool: Seven
    target: Seven | None


class ShownPair(TypedDict):
    """The pair of bodies with the least margin."""

    ends: tuple[Point, Point]
    margin: float  # [m]


class ShownState(TypedDict):
    """A moment of a run."""

    arms: dict[str, ShownArm]
    joints: list[Seven]  # Poses, by the index of the joint in the meshes.
    parts: dict[str, Seven]
    pair: ShownPair | None
    recording: str


class ShownVibration(TypedDict):
    """A vibration, with frequency and amplitude from 0 to 1."""

    hand: str
    frequency: float
    amplitude: float


class FromRun(TypedDict):
    """A message with any of these fields."""

    scene: NotRequired[ShownScene]
    state: NotRequired[ShownState]
    acknowledged: NotRequired[int]  # Sent with a state: the number of the newest message of the page.
    vibration: NotRequired[ShownVibration]
    driver: NotRequired[str]  # Sent to a page that watches: the page that drives.
