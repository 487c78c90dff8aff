"""Cameras stand and look as the cell says. No test here needs OpenGL."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import PlantError
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.plants.mujoco_cameras import draw_obstacles
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from tests.support.processes import cell


def axes(**camera: object) -> tuple[Array, Array]:
    """Return the camera's position, and the right, upward and backward directions of its picture as columns."""
    config = cell().model_copy(update={"cameras": {"one": CameraConfig.model_validate(camera)}})
    plant = MujocoPlant(Robot.from_config(config), config)
    mujoco.mj_camlight(plant.model, plant.data)
    found = plant.data.camera("one")
    return found.xpos.copy(), found.xmat.reshape(3, 3).copy()


def test_a_camera_that_looks_at_a_point_shows_the_point_in_the_middle_of_an_upright_picture() -> None:
    position, turned = axes(position=(2, 1, 1.5), look_at=(0.5, 0, 0))
    right, up, back = turned.T
    np.testing.assert_allclose(position, (2, 1, 1.5))
    np.testing.assert_allclose(np.cross(-back, np.array((0.5, 0, 0)) - position), 0, atol=1e-12)
    assert -back @ (np.array((0.5, 0, 0)) - position) > 0
    assert right[2] == pytest.approx(0.0)
    assert up[2] > 0.5


def test_a_camera_without_rotation_looks_along_x_with_z_up_and_a_camera_that_looks_down_has_x_up() -> None:
    along_x, down = axes(position=(0, 0, 1), rpy=(0, 0, 0))[1].T, axes(position=(0.5, 0, 2), look_at=(0.5, 0, 0))[1].T
    np.testing.assert_allclose(along_x, ((0, -1, 0), (0, 0, 1), (-1, 0, 0)), atol=1e-12)
    np.testing.assert_allclose(down, ((0, -1, 0), (1, 0, 0), (0, 0, 1)), atol=1e-12)


def test_the_error_for_a_camera_on_a_missing_link_names_the_existing_links() -> None:
    with pytest.raises(PlantError, match=r"cameras\.one\.link = 'hand': no such link; allowed: left_link_0, "):
        axes(link="hand", position=(0, 0, 1), rpy=(0, 0, 0))


def test_a_window_without_a_display_is_refused(plant: MujocoPlant, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(PlantError, match=r"needs a display: .*; --web shows the arms in a browser"):
        plant.launch_viewer()
    assert plant.viewer_sync() is False


def test_the_window_draws_moving_obstacles_at_their_poses_while_they_exist(plant: MujocoPlant) -> None:
    scene = mujoco.MjvScene(plant.model, maxgeom=8)
    shapes = [("sphere", (0.1,)), ("capsule", (0.1, 0.4)), ("box", (0.1, 0.2, 0.4))]
    turned = {"position": (0.6, 0.4, 0.3), "rpy": (0.0, np.pi / 2, 0.0), "speed": 0.2}
    many = [MovingObstacle.model_validate({"shape": shape, "size": size, **turned}) for shape, size in shapes]
    draw_obstacles(scene, [(one, (0, 51, 255)) for one in many])
    drawn = scene.geoms[: scene.ngeom]
    kinds = [mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX]
    assert [one.type for one in drawn] == kinds
    np.testing.assert_allclose([one.size for one in drawn], [(0.1, 0.1, 0.1), (0.1, 0.1, 0.2), (0.05, 0.1, 0.2)])
    for one in drawn:
        np.testing.assert_allclose(one.pos, (0.6, 0.4, 0.3), rtol=1e-6)
        np.testing.assert_allclose(one.mat @ (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), atol=1e-6)
        np.testing.assert_allclose(one.rgba[:3], (0.0, 0.2, 1.0), atol=1e-6)
    draw_obstacles(scene, [])
    assert scene.ngeom == 0
