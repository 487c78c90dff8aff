"""Relative motion: how the target moves when the hand moves."""

from __future__ import annotations

import math
from itertools import pairwise, permutations, product

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.errors import ConfigError, Q2R2Error
from q2r2_control.teleop.relative import RelativeMotion
from tests.teleop.hands import pose

STANCES = ("side_by_side", "mirror", "mirror_reflected")
FRAMES = ("base", "tool")
REFLECTION = np.diag([1.0, -1.0, 1.0])

numbers = st.floats(-3.0, 3.0)
poses = st.builds(lambda x, y, z, a, b, c: pose(x, y, z, (a, b, c)), *[numbers] * 6)
quick = settings(derandomize=True, max_examples=60, deadline=None)


def assert_same(a: pin.SE3, b: pin.SE3, tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(a.homogeneous, b.homogeneous, atol=tolerance)


def anchored(hand: pin.SE3, tool: pin.SE3, **settings: object) -> RelativeMotion:
    motion = RelativeMotion(**settings)  # type: ignore[arg-type]
    motion.anchor(hand, tool)
    return motion


@quick
@given(
    hand=poses,
    tool=poses,
    wanted=poses,
    stance=st.sampled_from(STANCES),
    frame=st.sampled_from(FRAMES),
    scale=st.floats(0.1, 5.0),
    axes=st.sampled_from([("+x", "+y", "+z"), ("+z", "-x", "+y")]),
)
def test_every_target_pose_can_be_reached_by_some_hand_pose(
    hand: pin.SE3, tool: pin.SE3, wanted: pin.SE3, stance: str, frame: str, scale: float, axes: tuple[str, ...]
) -> None:
    settings: dict[str, object] = {"stance": stance, "rotation_frame": frame, "scale": scale, "axes": axes}
    motion = anchored(hand, tool, **settings)
    assert_same(motion.hand(tool), hand)
    assert_same(motion.target(motion.hand(wanted)), wanted)
    motion = anchored(hand, tool, **settings, rotation_scale=1.0 + 0.5 * scale)
    assert_same(motion.target(motion.hand(wanted)), wanted)


@quick
@given(hand=poses, tool=poses, moved=poses)
def test_the_tool_repeats_the_hands_motion_in_the_world_frame_in_the_tool_frame_or_reflected(
    hand: pin.SE3, tool: pin.SE3, moved: pin.SE3
) -> None:
    way, turn = moved.translation - hand.translation, moved.rotation @ hand.rotation.T
    for stance, to_world in (("side_by_side", np.eye(3)), ("mirror_reflected", REFLECTION)):
        target = anchored(hand, tool, stance=stance).target(moved)
        np.testing.assert_allclose(target.translation - tool.translation, to_world @ way, atol=1e-9)
        np.testing.assert_allclose(target.rotation @ tool.rotation.T, to_world @ turn @ to_world, atol=1e-9)
    target = anchored(hand, tool, rotation_frame="tool").target(moved)
    np.testing.assert_allclose(tool.rotation.T @ target.rotation, hand.rotation.T @ moved.rotation, atol=1e-9)
    np.testing.assert_allclose(target.translation - tool.translation, way, atol=1e-9)


@pytest.mark.parametrize("frame", FRAMES)
def test_scales_multiply_the_displacement_and_the_rotation_vector(frame: str) -> None:
    motion = anchored(pose(), pose(), scale=0.5, rotation_scale=2.0, rotation_frame=frame)
    target = motion.target(pose(0.2, -0.4, 0.6, (0.1, 0.2, -0.3)))
    np.testing.assert_allclose(target.translation, [0.1, -0.2, 0.3], atol=1e-12)
    np.testing.assert_allclose(pin.log3(target.rotation), [0.2, 0.4, -0.6], atol=1e-12)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("wobble", [0.0, 0.2], ids=["about one axis", "with a wobble"])
@pytest.mark.parametrize("scale", [0.3, 1.0, 2.0])
def test_the_tool_turns_steadily_while_the_hand_makes_three_turns(scale: float, wobble: float, frame: str) -> None:
    motion = anchored(pose(), pose(), rotation_scale=scale, rotation_frame=frame)
    step = 0.02

    def hand(angle: float) -> pin.SE3:
        tilt = pin.exp3(wobble * np.array([math.sin(angle), 0.0, 0.0]))
        return pin.SE3(pin.exp3(np.array([0.0, 0.0, angle])) @ tilt, np.zeros(3))

    targets = [motion.target(hand(angle)) for angle in np.arange(0.0, 6.0 * math.pi, step)]
    turns = [float(np.linalg.norm(pin.log3(a.rotation.T @ b.rotation))) for a, b in pairwise(targets)]
    assert max(turns) < 4.0 * scale * step


AXES = [
    tuple(sign + axis for sign, axis in zip(signs, order, strict=True))
    for order in permutations("xyz")
    for signs in product("+-", repeat=3)
]


@pytest.mark.parametrize("axes", AXES, ids=" ".join)
def test_one_physical_motion_moves_the_tool_alike_in_every_axis_convention_of_the_input(
    axes: tuple[str, str, str],
) -> None:
    """A motion is expressed in the input's frame and in the world frame. Both descriptions move the tool alike."""
    to_world = np.array([[float(axis[0] + "1") * (name == axis[1]) for name in "xyz"] for axis in axes])

    def as_sent(physical: pin.SE3) -> pin.SE3:
        return pin.SE3(to_world.T @ physical.rotation @ to_world, to_world.T @ physical.translation)

    hand, moved, tool = pose(1, 2, 3, (0.3, 0.1, 2.0)), pose(1.1, 1.8, 3.3, (1.0, -1.0, 0.5)), pose(0, 0, 1, (3, 0, 0))
    for frame in FRAMES:
        physical = anchored(hand, tool, rotation_frame=frame).target(moved)
        assert_same(anchored(as_sent(hand), tool, axes=axes, rotation_frame=frame).target(as_sent(moved)), physical)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"axes": ("+x", "+x", "+z")}, "axes .* use x, y and z once each"),
        ({"axes": ("+x", "+y")}, "axes"),
        ({"stance": "behind"}, "stance = 'behind'.*side_by_side"),
        ({"rotation_frame": "hand"}, "rotation_frame = 'hand'.*base"),
        ({"scale": 0.0}, "position_scale = 0.0.*more than 0"),
        ({"rotation_scale": -1.0}, "rotation_scale = -1.0"),
    ],
    ids=lambda value: str(value) if isinstance(value, dict) else "",
)
def test_the_error_for_a_forbidden_setting_names_the_setting_and_the_allowed_values(
    arguments: dict[str, object], message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        RelativeMotion(**arguments)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_a_target_without_an_anchor_is_refused() -> None:
    with pytest.raises(Q2R2Error, match="anchor"):
        RelativeMotion().target(pose())
