"""The scene of the page: robot, ghost, targets, trails, the tightest pair, obstacles and loose parts."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
import viser

from q2r2_control.types import Array, RobotState
from q2r2_control.viewer.joint_tree import Colour, JointTree, colour_of
from q2r2_control.viewer.state_colours import AMBER, GREEN, GREY, RED, state_colour
from q2r2_control.viewer.tightest_pair import TightestPair
from q2r2_control.viewer.web.exchange import Frame, PageSetup
from q2r2_control.viewer.web.figure import CapsuleFigure, ObstacleFigure, RobotFigure, place

_TRAIL_COLOURS: tuple[Colour, ...] = ((60, 120, 216), (150, 80, 190))
_TRAIL = 90  # Number of points of a trail.
_TRAIL_PERIOD = 0.05  # Time between the points of a trail, in the run's time [s].
_BREAK = 1.0  # If the time between two points would be longer than this, a new trail begins [s].
_AWAY = 0.01  # The ghost is shown if a joint is farther from its reference than this [rad].
_SHORT = 0.01  # Lines up to this length are not drawn [m].
_PER_NEWTON = 0.005  # Drawn length per force [m/N].
# Forces are computed only in directions in which the Jacobian's singular value, divided by its largest one, is above
# this number.
_SINGULAR = 0.05
_NEAR = 0.1  # A pair with this margin or more is green [m].
_CAMERA = np.array([-1.8, 0.35, 1.5])  # Vector from the middle of the arms to the first position of the camera [m].
FIELD_OF_VIEW = math.radians(40.0)  # Vertical angle of the camera's view [rad].
_BACKGROUND: Colour = (238, 241, 244)


def first_view(model: pin.Model, home: Array) -> tuple[Array, Array]:
    """Return the first position of the camera, and the point that it looks at (3,) [m], in the world frame.

    The position is behind the arms and above them. As for an operator who stands there, the left arm is on the left.
    """
    data = model.createData()
    pin.forwardKinematics(model, data, home)
    places = np.array([placement.translation for placement in list(data.oMi)[1:]])
    middle: Array = (places.min(axis=0) + places.max(axis=0)) / 2.0
    return middle + _CAMERA, middle


class CellScene:
    """Draws frames. After the scene is built, only :meth:`show` may be called, and only by one thread."""

    def __init__(self, server: viser.ViserServer, setup: PageSetup) -> None:
        scene, config = server.scene, setup.config
        self._setup = setup
        self._model, self._data = setup.model, setup.model.createData()
        self._tightest = TightestPair(setup.model, setup.collision_model)
        self._tree = JointTree(setup)
        scene.set_up_direction("+z")
        scene.configure_default_lights(cast_shadow=False)  # Without a GPU, shadows slow a browser down tenfold.
        scene.set_background_image(np.full((2, 2, 3), _BACKGROUND, dtype=np.uint8))
        scene.add_grid(
            "/floor",
            *(6.0, 6.0),
            position=(0.0, 0.0, (config.floor or 0.0) - 0.001),
            cell_size=0.1,
            section_size=0.5,
            cell_color=(214, 219, 224),
            section_color=(188, 195, 202),
            plane_color=(246, 247, 249),
            plane_opacity=1.0,
            shadow_opacity=0.2,
        )
        self._robot, self._ghost = (
            RobotFigure(scene, "/robot", self._tree),
            RobotFigure(scene, "/ghost", self._tree, True),
        )
        self._capsules = CapsuleFigure(scene, "/capsules", setup.collision_model)
        self._obstacles = ObstacleFigure(scene, "/obstacles")
        self._ghost_always = self._add_choices(server)
        arms = list(setup.joints)
        look = {"axes_length": 0.08, "axes_radius": 0.003, "origin_radius": 0.012, "visible": False}
        self._targets = {arm: scene.add_frame(f"/targets/{arm}", **look) for arm in arms}
        self._tools = {arm: scene.add_frame(f"/tools/{arm}", show_axes=False) for arm in arms}
        pin.forwardKinematics(self._model, self._data, setup.home)
        for arm, joints in setup.joints.items():
            first = self._data.oMi[self._model.getJointId(setup.joint_names[joints[0]])].translation
            scene.add_label(f"/names/{arm}", arm, position=first, anchor="top-center")
        nothing = np.zeros((_TRAIL - 1, 2, 3), dtype=np.float32)
        # The trail of each tool; and, as a thinner line, the trail of its target, which shows the hand's motion.
        self._trails = {
            (arm, kind): scene.add_line_segments(f"/trails/{arm}_{kind}", nothing, _faded(colour), line_width=width)
            for arm, colour in zip(arms, _TRAIL_COLOURS, strict=False)
            for kind, width in (("tool", 2.5), ("hand", 1.0))
        }
        self._trail_points: dict[tuple[str, str], Array] = {}
        no_line = np.zeros((1, 2, 3))
        self._leashes = {
            arm: scene.add_line_segments(f"/leashes/{arm}", no_line, AMBER, line_width=2.0) for arm in arms
        }
        self._forces = {arm: scene.add_line_segments(f"/forces/{arm}", no_line, RED, line_width=5.0) for arm in arms}
        self._trail_time = -math.inf
        self._pair = scene.add_line_segments("/tightest_pair", np.zeros((1, 2, 3)), GREY, line_width=4.0)
        self._pair_label = scene.add_label("/tightest_pair_distance", "", anchor="bottom-center", visible=False)
        self._parts = {
            name: scene.add_box(f"/parts/{name}", colour_of(part.colour), part.size, visible=False)
            for name, part in config.mujoco.objects.items()
            if name in setup.parts
        }
        for arm, box in config.teleop.workspace.items():
            lower, upper = np.array([box.x, box.y, box.z]).T
            scene.add_box(
                f"/workspaces/{arm}", GREY, upper - lower, position=(lower + upper) / 2.0, wireframe=True, opacity=0.5
            )
        camera = server.initial_camera
        camera.position, camera.look_at = first_view(self._model, setup.home)
        camera.fov = FIELD_OF_VIEW

    def _add_choices(self, server: viser.ViserServer) -> viser.GuiInputHandle[bool]:
        """Add checkboxes for things that are drawn on request.

        Return the checkbox for the ghost, which is the robot at its reference. If checked, the ghost is always drawn.
        """
        with server.gui.add_folder("View", order=1e9, expand_by_default=False):
            shadows = server.gui.add_checkbox("shadows", False, hint="slow without a graphics card")
            capsules = server.gui.add_checkbox("shapes that are kept apart", False)
            ghost = server.gui.add_checkbox("reference always", False)

        @shadows.on_update
        def _(_: object) -> None:
            server.scene.configure_default_lights(cast_shadow=bool(shadows.value))

        @capsules.on_update
        def _(_: object) -> None:
            self._capsules.root.visible = bool(capsules.value)

        return ghost

    def show(self, frame: Frame) -> None:
        """Draw one frame."""
        tick = frame.tick
        self._robot.show(self._tree.posture(tick.state.q, tick.grippers))
        away = bool(np.abs(tick.state.q - tick.reference.q).max() > _AWAY) or self._ghost_always.value
        self._ghost.root.visible = away
        if away:
            self._ghost.show(self._tree.posture(tick.reference.q, tick.grippers))
        for arm, tool in tick.tools.items():
            place(self._tools[arm], tool)
            target, node = tick.targets[arm].pose, self._targets[arm]
            node.visible = target is not None
            if target is not None:
                node.origin_color = state_colour(tick.states[arm])
                place(node, target)
            self._show_line(self._leashes[arm], tool, None if target is None else target.translation - tool.translation)
            self._show_line(self._forces[arm], tool, self._force(arm, tick.state))
        self._obstacles.show(tick.obstacles)
        self._show_trails(frame)
        self._show_pair(frame)
        for name, box in self._parts.items():
            if frame.moved is not None:
                at = self._setup.parts[name]
                box.position, box.wxyz = frame.moved[at : at + 3], frame.moved[at + 3 : at + 7]
                box.visible = True

    def _show_line(self, line: viser.LineSegmentsHandle, tool: pin.SE3, vector: Array | None) -> None:
        """Draw a line from a ``tool`` along ``vector`` (3,) [m]. Hide the line if the vector is None or very short."""
        line.visible = vector is not None and float(np.linalg.norm(vector)) > _SHORT
        if line.visible:
            line.points = np.array([[tool.translation, tool.translation + vector]])

    def _force(self, arm: str, state: RobotState) -> Array | None:
        """Return the vector (3,) with which the force on a tool is drawn [m]; None if the plant measures no torques."""
        if state.tau_external is None:
            return None
        frame, joints = self._setup.tools[arm], self._setup.joints[arm]
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobian = pin.computeFrameJacobian(self._model, self._data, state.q, frame, world)[:, joints]
        wrench = np.linalg.lstsq(jacobian.T, state.tau_external[joints], rcond=_SINGULAR)[0]
        return _PER_NEWTON * wrench[:3]

    def _show_trails(self, frame: Frame) -> None:
        tick = frame.tick
        if 0.0 <= tick.t - self._trail_time < _TRAIL_PERIOD:
            return
        if not 0.0 <= tick.t - self._trail_time < _BREAK:
            self._trail_points.clear()  # The trails are dropped, because the user has moved the time line of a replay.
        self._trail_time = tick.t
        for (arm, kind), trail in self._trails.items():
            target = tick.targets[arm].pose
            trail.visible = kind == "tool" or target is not None
            if kind == "hand" and target is None:
                self._trail_points.pop((arm, kind), None)
                continue
            pose = tick.tools[arm] if kind == "tool" or target is None else target
            here = pose.translation.astype(np.float32)
            points = self._trail_points.get((arm, kind))
            points = np.tile(here, (_TRAIL, 1)) if points is None else np.vstack([points[1:], here])
            self._trail_points[arm, kind] = points
            trail.points = np.stack([points[:-1], points[1:]], axis=1)

    def _show_pair(self, frame: Frame) -> None:
        report = frame.tick.reference.report
        self._tightest.place(frame.tick.reference.q)
        if self._capsules.root.visible:
            self._capsules.show(self._tightest.placed)
        ends = self._tightest.ends(report)
        self._pair.visible = self._pair_label.visible = ends is not None
        if ends is None:
            return
        calm = min(max(report.margin / _NEAR, 0.0), 1.0)
        colour = tuple(round(calm * one + (1.0 - calm) * other) for one, other in zip(GREEN, RED, strict=True))
        self._pair.points, self._pair.colors = ends[None], np.array([[colour, colour]], dtype=np.uint8)
        self._pair_label.text = f"{1e3 * report.margin:.0f} mm to spare"
        self._pair_label.position = ends.mean(axis=0)


def _faded(colour: Colour) -> Array:
    """Return the colours (segments, 2, 3) of a trail, which begin with the background's colour at its old end."""
    part = np.linspace(0.0, 1.0, _TRAIL)[:, None]
    colours = (part * colour + (1.0 - part) * _BACKGROUND).astype(np.uint8)
    made: Array = np.stack([colours[:-1], colours[1:]], axis=1)
    return made
