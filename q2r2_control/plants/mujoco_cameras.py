"""The cell's cameras in MuJoCo: their poses in the model, pictures without a window, and MuJoCo's window."""

from __future__ import annotations

import copy
import threading
import warnings
from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import PlantError
from q2r2_control.extras import importing
from q2r2_control.process.machine_notes import has_display
from q2r2_control.types import Array

with importing("sim", "the simulation in MuJoCo"):
    import mujoco

# Rotation from the axes of a MuJoCo camera to the axes of our cameras. A MuJoCo camera looks along -z, and y points up
# in the picture. Our cameras look along x, and z points up.
_FROM_OURS = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
# If the sine of the angle between the line of sight and the vertical is smaller than this, the camera counts as looking
# straight up or down.
_STRAIGHT = 1e-9
_LONGEST_CLOSE = 5.0  # Longest time to wait until a window is closed [s].
_OPACITY = 0.6  # Opacity of moving obstacles.
# Size of the shadow map [pixels], number of samples per pixel, and numbers of slices and stacks of round shapes. Larger
# values take longer on a computer without a graphics card. A picture takes five times as long with the values that
# MuJoCo's window has for the first two settings (8192 and 8). It takes twice as long with MuJoCo's default numbers of
# slices and stacks (28 and 16).
_SHADOW_MAP, _SAMPLES, _ROUND = 1024, 0, (16, 8)


def add_cameras(spec: mujoco.MjSpec, cameras: Mapping[str, CameraConfig]) -> None:
    """Put cameras into a cell; raises :class:`PlantError` for a camera on a link that does not exist."""
    for name, camera in cameras.items():
        body = spec.worldbody if camera.link is None else spec.body(camera.link)
        if body is None:
            links = ", ".join(body.name for body in spec.bodies[1:])
            raise PlantError(f"cameras.{name}.link = {camera.link!r}: no such link; allowed: {links}")
        body.add_camera(
            name=name,
            pos=camera.position,
            quat=np.roll(pin.Quaternion(_orientation(camera) @ _FROM_OURS).coeffs(), 1),
            fovy=np.rad2deg(camera.field_of_view),
        )


def _orientation(camera: CameraConfig) -> Array:
    """Return the rotation (3, 3) of the camera's frame in its link's frame. x is the line of sight, and y is level."""
    assert camera.position is not None
    if camera.look_at is None:
        assert camera.rpy is not None
        return np.array(pin.rpy.rpyToMatrix(*camera.rpy))
    sight = np.subtract(camera.look_at, camera.position)
    sight /= np.linalg.norm(sight)
    left = np.cross((0.0, 0.0, 1.0), sight)
    if np.linalg.norm(left) < _STRAIGHT:  # The camera looks straight up or down. The link's x is up in the picture.
        left = np.cross((1.0, 0.0, 0.0), sight)
    left /= np.linalg.norm(left)
    return np.stack((sight, left, np.cross(sight, left)), axis=1)


class CellPictures:
    """Takes pictures with the cameras of a model. Only one thread may use an instance.

    The reason is that an OpenGL context belongs to one thread.
    """

    def __init__(self, model: mujoco.MjModel, cameras: Mapping[str, CameraConfig]) -> None:
        """Prepare pictures of a simulated cell.

        Args:
            model: The model of a :class:`MujocoPlant`. Settings of its drawing are changed.
            cameras: At least one of the cell's ``simulated_cameras``, by name.

        Raises:
            PlantError: If OpenGL cannot draw without a window.
        """
        model.vis.quality.shadowsize, model.vis.quality.offsamples = _SHADOW_MAP, _SAMPLES
        model.vis.quality.numslices, model.vis.quality.numstacks = _ROUND
        model.vis.global_.offwidth = max(camera.width for camera in cameras.values())
        model.vis.global_.offheight = max(camera.height for camera in cameras.values())
        self._model, self._data = model, mujoco.MjData(model)
        sizes = {name: (camera.height, camera.width) for name, camera in cameras.items()}
        try:
            renderers = {size: mujoco.Renderer(model, *size) for size in set(sizes.values())}
        # Without OpenGL's library, PyOpenGL fails with an error about the first name that it looks up.
        except (ImportError, AttributeError, RuntimeError, mujoco.FatalError) as error:
            reason = " ".join(str(error).split())
            raise PlantError(
                f"no pictures: {reason}; allowed: MUJOCO_GL=egl (on Debian libegl1 and libgl1-mesa-dri), or "
                "MUJOCO_GL=osmesa (libosmesa6)"
            ) from error
        self._renderers = {name: renderers[size] for name, size in sizes.items()}

    def place(self, qpos: Array) -> None:
        """Move the cell to ``qpos`` (model.nq,), as a plant has it in ``observed_qpos``."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)

    def take(self, camera: str) -> npt.NDArray[np.uint8]:
        """Return the picture (height, width, 3), r g b, of the cell at the positions of the last :meth:`place`."""
        renderer = self._renderers[camera]
        renderer.update_scene(self._data, camera)
        return np.asarray(renderer.render())


class ThreadPictures:
    """Takes pictures of a cell in any thread. Each thread gets a :class:`CellPictures` of its own when it needs one."""

    def __init__(self, model: mujoco.MjModel, cameras: Mapping[str, CameraConfig]) -> None:
        self._model, self._cameras, self._own = model, cameras, threading.local()

    def take(self, camera: str, qpos: Array) -> npt.NDArray[np.uint8]:
        """Return the picture (height, width, 3), r g b, of the cell at ``qpos``; raises :class:`PlantError`."""
        if not hasattr(self._own, "cell"):
            # The model is copied, because CellPictures changes settings of the drawing that the plant's window uses
            # too.
            self._own.cell = CellPictures(copy.copy(self._model), self._cameras)
        cell: CellPictures = self._own.cell
        cell.place(qpos)
        return cell.take(camera)


def window_fault() -> str | None:
    """Return why no window can be opened, or None. MuJoCo itself would wait for ever for a window that cannot open."""
    if not has_display():
        lacks = "neither DISPLAY nor WAYLAND_DISPLAY is set"
        return f"MuJoCo's window needs a display: {lacks}; --web shows the arms in a browser"
    import glfw

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", glfw.GLFWError)
        if glfw.init():
            glfw.window_hint(glfw.VISIBLE, False)
            window = glfw.create_window(64, 64, "", None, None)
            glfw.default_window_hints()
            if window:
                glfw.destroy_window(window)
                return None
    return "MuJoCo's window cannot be opened on this display; run headless"


def open_window(model: mujoco.MjModel, data: mujoco.MjData) -> mujoco.viewer.Handle:
    """Open MuJoCo's passive viewer on a running simulation; raises :class:`PlantError` if there is no display."""
    if (fault := window_fault()) is not None:
        raise PlantError(fault)
    from mujoco import viewer

    try:
        return viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
    except (RuntimeError, mujoco.FatalError) as error:
        raise PlantError(f"MuJoCo's window cannot be opened: {error}") from error


def close_window(window: mujoco.viewer.Handle) -> None:
    """Close the window and wait for its thread. If a thread still draws when the process ends, the process crashes."""
    window.close()
    for thread in threading.enumerate():
        if "_launch_internal" in thread.name:  # The thread has the name of MuJoCo's function.
            thread.join(_LONGEST_CLOSE)


# For each of our shapes, MuJoCo's kind of shape, and the factors from our sizes to MuJoCo's.
_DRAWN = {
    "sphere": (mujoco.mjtGeom.mjGEOM_SPHERE, (1.0,)),
    "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, (1.0, 0.5)),
    "box": (mujoco.mjtGeom.mjGEOM_BOX, (0.5, 0.5, 0.5)),
}


def draw_obstacles(scene: mujoco.MjvScene, obstacles: Iterable[tuple[MovingObstacle, tuple[int, int, int]]]) -> None:
    """Draw only these obstacles into ``scene``, each in its colour r g b."""
    scene.ngeom = 0
    for obstacle, colour in obstacles:
        kind, factors = _DRAWN[obstacle.shape]
        size, rgba = np.zeros(3), np.append(np.divide(colour, 255.0), _OPACITY)
        size[: len(factors)] = np.multiply(obstacle.size, factors)
        turned = pin.rpy.rpyToMatrix(*obstacle.rpy).ravel()
        mujoco.mjv_initGeom(scene.geoms[scene.ngeom], kind, size, np.array(obstacle.position), turned, rgba)
        scene.ngeom += 1
