"""robots/hand_e.urdf: fingers, tool frame, and the envelopes that represent the hand in every distance."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import coal
import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.robot.description import load_description
from q2r2_control.types import Array

FLANGE_TO_TIPS = 0.1565  # Distance from the flange to the finger tips [m].


@pytest.fixture(scope="module")
def hand() -> tuple[pin.Model, pin.GeometryModel]:
    text = ET.tostring(load_description("hand_e").urdf, encoding="unicode")
    model = pin.buildModelFromXML(text)
    return model, pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)


def _points_of(shape: coal.CollisionGeometry) -> Array:
    """Return points on and in a box or a cylinder, without a gap of more than a millimetre near an edge."""
    if isinstance(shape, coal.Box):
        axes = [np.linspace(-half, half, 13) for half in shape.halfSide]
        return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    angles = np.linspace(0, 2 * np.pi, 48)
    heights = np.linspace(-shape.halfLength, shape.halfLength, 60)
    return np.array([(shape.radius * np.cos(a), shape.radius * np.sin(a), z) for a in angles for z in heights])


def _outside(point: Array, capsule: pin.GeometryObject, placement: pin.SE3) -> float:
    local = placement.actInv(point)
    half = capsule.geometry.halfLength
    return float(np.linalg.norm(local - [0, 0, np.clip(local[2], -half, half)])) - float(capsule.geometry.radius)


@pytest.mark.slow
@pytest.mark.parametrize("opening", [0.0, 0.005, 0.0125, 0.02, 0.025])
def test_the_envelopes_of_the_hand_e_contain_its_body_and_its_fingers_at_every_opening(
    hand: tuple[pin.Model, pin.GeometryModel], opening: float
) -> None:
    model, geometry = hand
    data, geometry_data = model.createData(), geometry.createData()
    pin.updateGeometryPlacements(model, data, geometry, geometry_data, np.full(2, opening))
    items = list(zip(geometry.geometryObjects, geometry_data.oMg, strict=True))
    envelopes = [(item, placement) for item, placement in items if "envelope" in item.name]
    contact = [(item, placement) for item, placement in items if "envelope" not in item.name]
    assert {type(item.geometry) for item, _ in envelopes} == {coal.Capsule}
    assert len(contact) == 3
    for item, placement in contact:
        for point in _points_of(item.geometry):
            outside = min(_outside(placement.act(point), capsule, where) for capsule, where in envelopes)
            assert outside <= 0, (item.name, placement.act(point))


def test_the_tool_frame_lies_between_the_finger_pads_13_mm_behind_the_tips(
    hand: tuple[pin.Model, pin.GeometryModel],
) -> None:
    model, _ = hand
    np.testing.assert_allclose([model.lowerPositionLimit, model.upperPositionLimit], [[0.0] * 2, [0.025] * 2])
    place = model.frames[model.getFrameId("tool_frame")].placement
    np.testing.assert_allclose(place.rotation, np.eye(3))
    np.testing.assert_allclose(place.translation, [0, 0, FLANGE_TO_TIPS - 0.013])
