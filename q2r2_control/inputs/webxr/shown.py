"""The types of the JSON that a run sends to the page. The types for the page's scripts are made from these classes.

Poses are x y z [m] qx qy qz qw in the world frame, and points are x y z [m]. Colours are r g b, from 0 to 255.
"""

from __future__ import annotations

from typing import NotRequired

from typing_extensions import TypedDict

Colour = tuple[int, int, int]
Seven = tuple[float, float, float, float, float, float, float]
Point = tuple[float, float, float]


class ShownMesh(TypedDict):
    """A mesh in the frame of a joint."""

    joint: int  # Index into ``ShownState.joints``.
    colour: Colour
    vertices: list[float]  # x y z of all vertices one after the other [m].
    faces: list[int]  # The indices of three vertices for each triangle, one triangle after the other.


class ShownPart(TypedDict):
    """A loose part, which is drawn as a box."""

    size: Point  # Lengths of the edges along x y z [m].
    colour: Colour


class ShownScene(TypedDict):
    """The data of a run that do not change."""

    name: str
    meshes: list[ShownMesh]
    hands: dict[str, list[int]]  # For each arm, the joints whose meshes move with the tool.
    parts: dict[str, ShownPart]
    floor: float  # Height of the floor [m].
    timeout: float  # An arm stops if no data of its hand come for this time [s].


class ShownArm(TypedDict):
    """An arm. ``why`` is the reason for its state, and ``next`` is what its operator can do.

    In both texts, the name of a control is in braces, since only the page knows the words of its device. ``hand`` is
    the hand that drives the arm, and ``colour`` is the colour of the state. ``silent`` is True if the arm has stopped
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

    ends: tuple[Point, Point]  # The nearest points of both bodies.
    margin: float  # [m]


class ShownState(TypedDict):
    """The state of a run at one time."""

    arms: dict[str, ShownArm]
    joints: list[Seven]  # The poses of the joints. ``ShownMesh.joint`` is an index into this list.
    parts: dict[str, Seven]  # Poses of the loose parts, by name.
    pair: ShownPair | None
    recording: str


class ShownVibration(TypedDict):
    """A vibration, with frequency and amplitude from 0 to 1."""

    hand: str
    frequency: float
    amplitude: float


class FromRun(TypedDict):
    """A message from the run to the page. It contains at least one of these fields."""

    scene: NotRequired[ShownScene]
    state: NotRequired[ShownState]
    acknowledged: NotRequired[int]  # Each state comes with the number of the newest message from the page.
    vibration: NotRequired[ShownVibration]
    driver: NotRequired[str]  # The page that drives. Only pages that watch get this field.
