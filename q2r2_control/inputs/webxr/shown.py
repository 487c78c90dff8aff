"""The shapes of what a run tells the page: JSON, whose types for the page's scripts are made of these classes.

Poses are x y z qx qy qz qw in the world, in metres; points are x y z. Colours are r g b, 0 to 255.
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
    hands: dict[str, list[int]]  # of each arm, joints that go with its tool
    parts: dict[str, ShownPart]
    floor: float  # [m]


class ShownArm(TypedDict):
    """An arm. In ``why`` and ``next``, a control stands as its name in braces: the page knows the device in hand."""

    state: str
    colour: Colour  # of the state
    why: str
    next: str
    hand: str  # that drives it
    tool: Seven
    target: Seven | None


class ShownPair(TypedDict):
    """The pair of bodies with the least to spare."""

    ends: tuple[Point, Point]
    margin: float  # [m]


class ShownState(TypedDict):
    """A moment of a run."""

    arms: dict[str, ShownArm]
    joints: list[Seven]  # by their index in the meshes
    parts: dict[str, Seven]
    pair: ShownPair | None
    recording: str


class ShownVibration(TypedDict):
    """A vibration, all 0 to 1."""

    hand: str
    frequency: float
    amplitude: float


class FromRun(TypedDict):
    """A message: any of these."""

    scene: NotRequired[ShownScene]
    state: NotRequired[ShownState]
    acknowledged: NotRequired[int]  # with a state: the number of the newest message of the page
    vibration: NotRequired[ShownVibration]
    driver: NotRequired[str]  # to a page that watches: who drives
