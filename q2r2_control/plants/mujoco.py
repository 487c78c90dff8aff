"""The cell in MuJoCo, with position servos or direct torques, fingers that grasp, and pushes for tests."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from q2r2_control.config.cell import Config
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.errors import PlantError
from q2r2_control.extras import importing
from q2r2_control.plants.base import GripperMotion, check_command, check_duration, check_joints
from q2r2_control.plants.mujoco_cameras import ThreadPictures, close_window, draw_obstacles, open_window
from q2r2_control.plants.mujoco_model import build_model, settle_mimics
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode, RobotState

with importing("sim", "the simulation in MuJoCo"):
    import mujoco

# Largest rounding error of the sum of all ticks' durations, in physics steps. A step that is due within this error is
# taken.
_STEP_ROUNDING = 1e-6

# In every posture the inertia of a joint is at least its armature: M >= diag(armature). If K dt^2 / armature <= 0.16
# and D dt / armature <= 1, all eigenvalues of M^-1 (2 D dt + K dt^2) stay below 4. At 4, the semi-implicit Euler
# integration becomes unstable.
_MAX_STIFFNESS_STEP, _MAX_DAMPING_STEP = 0.16, 1.0


@dataclass(frozen=True, slots=True)
class _Fingers:
    """The indices of one gripper's joints in MuJoCo's arrays, and the joints' positions when fully open and closed."""

    positions: list[int]
    actuators: list[int]
    open_position: float
    closed_position: float

    def opening(self, qpos: Array) -> float:
        total = 0.0
        for index in self.positions:
            total += qpos.item(index)
        stroke = self.open_position - self.closed_position
        return min(max((total / len(self.positions) - self.closed_position) / stroke, 0.0), 1.0)


class MujocoPlant:
    """The simulated cell. The mode of each command chooses how the arms are driven.

    In position mode each joint has a servo, tau = K (q_ref - q) + D (v_ref - v) + M a_ref + bias. M and the bias
    (gravity and Coriolis) come from the simulator, and tau is clipped at the torque limits. The reference moves
    straight from the last command to the newest one. Without a new command it rests. In velocity mode the same servos
    follow a reference that moves at the commanded velocity for one ``advance``. In torque mode the commanded torque is
    clipped and applied, and the sender has to compensate gravity.
    """

    modes: tuple[CommandMode, ...] = (CommandMode.POSITION, CommandMode.VELOCITY, CommandMode.TORQUE)
    simulated = True

    def __init__(self, robot: Robot, config: Config) -> None:
        """Build the MuJoCo model of a cell, whose ``config`` must be the one that ``robot`` was built from.

        Raises:
            PlantError: If MuJoCo cannot model the robot.
        """
        self.model: mujoco.MjModel = build_model(robot, config)
        self.data: mujoco.MjData = mujoco.MjData(self.model)
        self._qpos, self._qvel = self.data.qpos, self.data.qvel
        self._bias, self._ctrl = self.data.qfrc_bias, self.data.ctrl
        self._robot, self._least_torque = robot, -robot.torque_limit
        self._arm_ctrl = self._ctrl[: len(robot.joint_names)]
        self._timestep = config.mujoco.timestep
        self._window: mujoco.viewer.Handle | None = None
        self._grippers = GripperMotion(config)
        self._fingers = {
            side: _Fingers(
                [self.model.joint(name).qposadr[0] for name in robot.arms[side].finger_joints],
                [self.model.actuator(name).id for name in robot.arms[side].finger_joints],
                arm.gripper.open_position,
                arm.gripper.closed_position,
            )
            for side, arm in config.arms.items()
            if arm.gripper.joints
        }
        self._q_index = np.array([self.model.joint(name).qposadr[0] for name in robot.joint_names])
        self._v_index = np.array([self.model.joint(name).dofadr[0] for name in robot.joint_names])
        self._tools = {arm.name: self.model.body(arm.tool_frame).id for arm in robot.arms.values()}
        self._acceleration = np.zeros(self.model.nv)
        self._inertial_torque = np.zeros(self.model.nv)
        # Positions of all moving bodies at the last :meth:`state` (model.nq,).
        self.observed_qpos: Array = self._qpos.copy()
        self._pictures = ThreadPictures(self.model, config.simulated_cameras)
        self.reset()
        self._stiffness, self._damping = self._tuned(config)

    @classmethod
    def from_config(cls, robot: Robot, config: Config) -> MujocoPlant:
        return cls(robot, config)

    def reset(self, q: Array | None = None) -> None:
        """See :meth:`Plant.reset`. Loose objects go back to their first poses, and pushes end."""
        posture = self._robot.home if q is None else q
        check_joints("reset q", posture, self._robot)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self._q_index] = posture
        self._grippers.reset()
        for fingers in self._fingers.values():
            self.data.qpos[fingers.positions] = fingers.open_position
        settle_mimics(self.model, self.data)
        self._start = self._end = self._at_rest(posture)  # Posture and velocity at both ends of the tick.
        self._next: tuple[Array, Array] | None = None  # Commanded posture and velocity at the end of the next tick.
        self._torque: Array | None = None  # Commanded torque in torque mode.
        self._velocity: Array | None = None  # Commanded velocity in velocity mode, for the next advance.
        # By arm, the wrench of a push, and the number of the physics step before which the push ends.
        self._pushes: dict[str, tuple[Array, int]] = {}
        self._steps = 0
        self._clock = 0.0
        mujoco.mj_forward(self.model, self.data)
        self._drive_fingers()
        self._drive_arms(self.data.qfrc_bias[self._v_index])
        mujoco.mj_forward(self.model, self.data)

    def apply(self, command: Command) -> None:
        check_command(command, self._robot, self.modes)
        self._velocity = command.v.copy() if command.mode is CommandMode.VELOCITY else None
        if command.mode is CommandMode.TORQUE:
            self._torque = command.tau.copy()
        else:
            if self._torque is not None:
                # After torque mode, there is no last commanded posture from which the reference could start. It starts
                # at the new command, or at the measured posture if a velocity is commanded.
                self._end = self._at_rest(command.q if self._velocity is None else self._qpos[self._q_index])
                self._next = self._torque = None
            if self._velocity is None:
                self._next = command.q.copy(), command.v.copy()
        self._grippers.command(command.grippers)

    def advance(self, dt: float) -> None:
        """See :meth:`Plant.advance`. All whole physics steps that are due are taken. The next call adds the rest.

        Raises:
            PlantError: If ``dt`` is not allowed, or if the simulation has diverged. ``reset`` makes it usable again.
        """
        check_duration(dt)
        if dt == 0:
            return
        start, self._clock = self._clock, self._clock + dt
        if self._velocity is not None:
            self._next, self._velocity = (self._end[0] + dt * self._velocity, self._velocity), None
        if self._next is None:
            # Without a new command, the arms stop, because a commanded velocity ends with its tick.
            self._start = self._end = self._at_rest(self._end[0])
        else:
            self._start, self._end, self._next = self._end, self._next, None
        self._grippers.advance(dt)
        self._drive_fingers()
        # A tick that is shorter than a step must not cause a very large acceleration.
        self._acceleration[self._v_index] = (self._end[1] - self._start[1]) / max(dt, self._timestep)
        due = math.floor(self._clock / self._timestep + _STEP_ROUNDING)
        while self._steps < due:
            # A step can begin before the tick in which it ends. For such a step, the servos use the posture and the
            # velocity at the start of the tick.
            self._step(max(self._steps * self._timestep - start, 0.0) / dt)
        if not math.isfinite(self._qvel.dot(self._qvel)):
            raise PlantError(f"the simulation diverged at {self._clock:.3f} s; reset it")

    def state(self) -> RobotState:
        """See :meth:`Plant.state`. External torques come from contacts, pushes and the hard stops of the joints."""
        index, data = self._v_index, self.data
        self.observed_qpos = self._qpos.copy()
        tau = data.qfrc_actuator.take(index)
        # ``qfrc_smooth`` is the sum of all forces except contacts and other constraints. Without the forces that are
        # not external, it contains only the pushes of :meth:`push` and of MuJoCo's window.
        external = (data.qfrc_constraint + data.qfrc_smooth - data.qfrc_passive + self._bias).take(index) - tau
        q, v = self._qpos.take(self._q_index), self._qvel.take(index)
        return RobotState(q, v, tau, external, self._steps * self._timestep)

    def picture_of(self, camera: str) -> Callable[[], npt.NDArray[np.uint8]]:
        """See :meth:`PicturedPlant.picture_of`."""
        # The array does not change later, because each ``state`` makes a new one.
        return partial(self._pictures.take, camera, self.observed_qpos)

    def gripper_openings(self) -> dict[str, float]:
        return {side: fingers.opening(self._qpos) for side, fingers in self._fingers.items()}

    def push(self, arm: str, wrench: Array, duration: float) -> None:
        """Push the tool of ``arm`` from now on. An earlier push ends.

        Args:
            arm: The arm.
            wrench: Force [N], then torque [Nm], in world axes at the origin of the tool frame (6,).
            duration: Duration of the push [s].

        Raises:
            PlantError: If an argument is not allowed.
        """
        if arm not in self._tools:
            raise PlantError(f"push: no arm {arm!r:.40}; arms: {', '.join(self._tools)}")
        wrench = np.array(wrench, dtype=np.float64)
        if wrench.shape != (6,) or not np.isfinite(wrench).all() or not 0 <= duration < math.inf:
            allowed = "expected six finite numbers and a time >= 0"
            raise PlantError(f"push: wrench {wrench!s:.80} for {duration:g} s; {allowed}")
        self._pushes[arm] = wrench, self._steps + round(duration / self._timestep)

    def launch_viewer(self) -> None:
        """Open MuJoCo's own window; raises :class:`PlantError` if there is no display."""
        if self._window is None:
            self._window = open_window(self.model, self.data)

    def viewer_say(self, words: str) -> None:
        """Write ``words`` into the window, if there is one. They replace earlier words."""
        if self._window is not None:
            self._window.set_texts((mujoco.mjtFontScale.mjFONTSCALE_150, mujoco.mjtGridPos.mjGRID_TOPLEFT, words, ""))

    def viewer_sync(self, obstacles: Iterable[tuple[MovingObstacle, tuple[int, int, int]]] = ()) -> bool:
        """See :meth:`WindowedPlant.viewer_sync`. It also returns False if there is no window."""
        if self._window is None or not self._window.is_running():
            return False
        draw_obstacles(self._window.user_scn, obstacles)
        self._window.sync()
        return True

    def close(self) -> None:
        if self._window is not None:
            close_window(self._window)
            self._window = None

    def _tuned(self, config: Config) -> tuple[Array, Array]:
        """Return stiffness [Nm/rad] and damping [Nm s/rad] of the servos (nv,). The timestep bounds both.

        The damping fits the effective inertia of each joint at home, if all other joints can move: 1 / (M^-1)_ii.
        """
        inverse = np.empty((self.model.nv, self.model.nv))
        mujoco.mj_solveM(self.model, self.data, inverse, np.eye(self.model.nv))
        effective = 1 / np.diag(inverse)[self._v_index]
        armature, dt = self.model.dof_armature[self._v_index], self._timestep
        stiffness = np.minimum(config.mujoco.position_stiffness, _MAX_STIFFNESS_STEP * armature / dt**2)
        damping = 2 * config.mujoco.position_damping_ratio * np.sqrt(stiffness * effective)
        return stiffness, np.minimum(damping, _MAX_DAMPING_STEP * armature / dt)

    @staticmethod
    def _at_rest(q: Array) -> tuple[Array, Array]:
        return np.array(q), np.zeros(len(q))

    def _step(self, fraction: float) -> None:
        """Take one physics step, which begins when ``fraction`` of the tick has passed."""
        mujoco.mj_step1(self.model, self.data)
        self._drive_arms(self._servo_torque(fraction) if self._torque is None else self._torque)
        self._apply_pushes()
        mujoco.mj_step2(self.model, self.data)
        self._steps += 1

    def _servo_torque(self, fraction: float) -> Array:
        (q, v), (end_q, end_v) = self._start, self._end
        if fraction > 0.0:
            q, v = q + fraction * (end_q - q), v + fraction * (end_v - v)
        mujoco.mj_mulM(self.model, self.data, self._inertial_torque, self._acceleration)
        torque = (self._inertial_torque + self._bias)[self._v_index]
        torque += self._stiffness * (q - self._qpos[self._q_index])
        torque += self._damping * (v - self._qvel[self._v_index])
        return torque

    def _drive_arms(self, torque: Array) -> None:
        np.minimum(np.maximum(torque, self._least_torque), self._robot.torque_limit, out=self._arm_ctrl)

    def _drive_fingers(self) -> None:
        for side, fingers in self._fingers.items():
            opening, closed = self._grippers.openings[side], fingers.closed_position
            for actuator in fingers.actuators:
                self._ctrl[actuator] = closed + opening * (fingers.open_position - closed)

    def _apply_pushes(self) -> None:
        if not self._pushes:
            return
        self._pushes = {arm: (wrench, end) for arm, (wrench, end) in self._pushes.items() if self._steps < end}
        data, applied = self.data, self.data.qfrc_applied
        applied[:] = 0
        for arm, (wrench, _) in self._pushes.items():
            body = self._tools[arm]
            mujoco.mj_applyFT(self.model, data, wrench[:3], wrench[3:], data.xpos[body], body, applied)
