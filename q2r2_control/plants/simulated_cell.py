"""The simulated cell of the ROS node ``mujoco_robot``. Commands come at any time, and the physics has fixed steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from q2r2_control.config.cell import Config
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode, RobotState

# A busy computer delivers commands unevenly. If the next command is late, a joint therefore goes on at its velocity for
# this number of intervals between commands. The other two numbers are the bounds of this time [s].
_COAST_INTERVALS, _SHORTEST_COAST, _LONGEST_COAST = 3.0, 0.01, 0.1
# Weight of the newest interval between commands in the running mean of these intervals.
_INTERVAL_SHARE = 0.1


class JointFollower:
    """Computes the wanted position of each joint at any time, from the newest command for this joint.

    A command has a posture and a velocity for one time. Until the next command, the joint moves on at that velocity. If
    no command comes for too long, the joint brakes at its ``acceleration_limit`` (nv,) [rad/s^2]. It therefore does not
    move for ever if the sender has ended. No joint moves faster than its ``velocity_limit`` (nv,) [rad/s]. The caller
    passes the times in [s].
    """

    def __init__(self, q: Array, acceleration_limit: Array, velocity_limit: Array) -> None:
        self._acceleration, self._velocity_limit = acceleration_limit, velocity_limit
        self.stop(q, np.zeros_like(q))

    def stop(self, q: Array, v: Array) -> None:
        """Forget all commands, and brake from posture ``q`` (nv,) [rad] and velocity ``v`` (nv,) [rad/s]."""
        self.q, self.v = q.copy(), np.minimum(np.maximum(v, -self._velocity_limit), self._velocity_limit)
        self._command_q, self._command_v = q.copy(), np.zeros_like(q)
        self._due = np.full(len(q), -np.inf)
        self._interval = np.full(len(q), _SHORTEST_COAST)

    def command(self, joints: Array, q: Array, v: Array | None, due: float) -> None:
        """Take posture ``q`` and velocity ``v`` of the joints with the indices ``joints`` at time ``due`` [s].

        Without ``v``, the velocity is the change of position since the last command, divided by the mean time between
        two commands.
        """
        interval = due - self._due[joints]
        known = (interval > 0.0) & (interval <= _LONGEST_COAST)
        mean = self._interval[joints]
        # The first interval after a silence is not used.
        mean = np.where(known, mean + _INTERVAL_SHARE * (interval - mean), mean)
        if v is None:
            v = np.where(known, (q - self._command_q[joints]) / mean, 0.0)
        limit = self._velocity_limit[joints]
        self._interval[joints] = mean
        self._command_q[joints] = q
        self._command_v[joints] = np.minimum(np.maximum(v, -limit), limit)
        self._due[joints] = due

    def advance(self, now: float, dt: float) -> None:
        """Move ``q`` and ``v`` on by ``dt`` [s], to the time ``now`` [s]."""
        age = now - self._due
        coast = np.minimum(np.maximum(_COAST_INTERVALS * self._interval, _SHORTEST_COAST), _LONGEST_COAST)
        fresh = age <= coast
        largest = self._velocity_limit * dt
        slower = np.sign(self.v) * np.maximum(np.abs(self.v) - self._acceleration * dt, 0.0)
        change = np.where(
            fresh, self._command_q + self._command_v * np.where(fresh, age, 0.0) - self.q, 0.5 * (self.v + slower) * dt
        )
        bounded = np.minimum(np.maximum(change, -largest), largest)
        self.q = self.q + bounded
        # A joint that is far from its wanted position catches up at its limit. ``v`` is then the velocity with which it
        # catches up.
        on_time = np.abs(change) <= largest
        self.v = np.where(fresh, np.where(on_time, self._command_v, bounded / dt), slower)


# Longest time that a late loop catches up [s]. The rest is dropped, because it would cause a jump.
_LONGEST_CATCH_UP = 0.05
# Time for which one torque acts [s]. A real robot stops if its sender misses a few periods. The simulation instead lets
# no time pass until the next torque.
_LONGEST_TORQUE = 0.012


class SimulatedCell:
    """The simulated arms and their commands. If commands cease, position servos stop and hold the arms.

    A method that takes a command returns None if it follows the command. If it refuses the command, nothing changes,
    and the method returns a line of text with the reason.
    """

    def __init__(self, robot: Robot, config: Config, hold_after: float, max_jump: float) -> None:
        self.robot = robot
        self.plant = MujocoPlant(robot, config)
        self.loose_objects = frozenset(config.mujoco.objects)
        self.dropped = 0.0  # Total time by which the simulation fell behind, or for which it waited for torques [s].
        self._hold_after, self._max_jump = hold_after, max_jump
        self._columns = {name: index for index, name in enumerate(robot.joint_names)}
        # Results are kept, because senders name the same joints again and again.
        self._select = lru_cache(maxsize=16)(self._find)
        self._timestep = config.mujoco.timestep
        self._follower = JointFollower(
            robot.home, robot.capped_acceleration(config.control.acceleration_limit), robot.velocity_limit
        )
        self.fingers = [joint for arm in robot.arms.values() for joint in arm.finger_joints]
        joints = [self.plant.model.joint(name) for name in self.fingers]
        self._finger_q = np.array([joint.qposadr[0] for joint in joints], dtype=int)
        self._finger_v = np.array([joint.dofadr[0] for joint in joints], dtype=int)
        self._finger_actuators = {
            arm: [self.plant.model.actuator(joint).id for joint in its.finger_joints] for arm, its in robot.arms.items()
        }
        self._time: float | None = None
        self.reset()

    def reset(self) -> None:
        """Put the arms at home, at rest, with open grippers and without a command."""
        self.plant.reset()
        self._follower.stop(self.robot.home, np.zeros_like(self.robot.home))
        self._tau: Array | None = None
        self._last_command = -math.inf
        self._openings = dict.fromkeys(self.plant.gripper_openings(), 1.0)

    def mode(self, now: float) -> str:
        """Return what moves the arms at ``now`` [s]: "position" or "torque" commands, or "holding" without commands."""
        if now - self._last_command > self._hold_after:
            return "holding"
        return "position" if self._tau is None else "torque"

    def command_positions(
        self, names: Sequence[str], q: Array, v: Array | None, now: float, delay: float = 0.0
    ) -> str | None:
        """Follow the positions ``q`` [rad] and, if known, the velocities ``v`` [rad/s] of the joints ``names``.

        Names of joints that the cell does not have are ignored. The command came at ``now`` [s], and is due ``delay``
        [s] later.
        """
        if fault := self._unusable(names, q, v, delay):
            return fault
        if isinstance(selected := self._select(tuple(names)), str):
            return selected
        ours, columns = selected
        q = q[ours]
        reference = self._follower.q if self._tau is None else self.plant.state().q
        jump = np.abs(q - reference[columns])
        if jump.max() > self._max_jump:
            worst = int(jump.argmax())
            name = self.robot.joint_names[columns[worst]]
            return f"{name} is asked to jump by {jump[worst]:.3f} rad; allowed: {self._max_jump:g}"
        if self._tau is not None:
            self._back_to_servos()
        self._follower.command(columns, q, None if v is None else v[ours], now + delay)
        self._last_command = now
        return None

    def command_velocities(self, v: Array, now: float) -> str | None:
        """Move all joints from their wanted positions at velocities ``v`` (nv,) [rad/s], which came at ``now`` [s]."""
        if len(v) != len(self._columns):
            return f"{len(v)} velocities for {len(self._columns)} joints"
        q = self._follower.q if self._tau is None else self.plant.state().q
        if self._time is not None:  # The follower has the position of the last physics step. It is moved on to ``now``.
            q = q + v * min(max(now - self._time, 0.0), _LONGEST_CATCH_UP)
        return self.command_positions(self.robot.joint_names, q, v, now)

    def command_torques(self, tau: Array, now: float) -> str | None:
        """Apply joint torques (nv,) [Nm] that came at ``now`` [s]. The sender has to compensate gravity."""
        if len(tau) != len(self._columns):
            return f"{len(tau)} torques for {len(self._columns)} joints"
        if not np.isfinite(tau).all():
            return "a torque is not finite"
        self._tau = tau.copy()
        self._last_command = now
        return None

    def command_gripper(self, arm: str, opening: float) -> None:
        """Open (1) or close (0) an arm's gripper."""
        self._openings[arm] = opening

    def gripper_state(self, arm: str) -> tuple[float, float]:
        """Return the opening of an arm's gripper, from 0 closed to 1 open, and the largest force of its finger servos.

        The force is in N, or in Nm if the fingers turn.
        """
        force = np.abs(self.plant.data.actuator_force[self._finger_actuators[arm]]).max()
        return self.plant.gripper_openings()[arm], float(force)

    def finger_positions(self) -> Array:
        """Return the positions of the joints ``fingers`` (n,) [m or rad]."""
        positions: Array = self.plant.data.qpos[self._finger_q]
        return positions

    def finger_velocities(self) -> Array:
        """Return the velocities of the joints ``fingers`` (n,) [m/s or rad/s]."""
        velocities: Array = self.plant.data.qvel[self._finger_v]
        return velocities

    def advance(self, now: float) -> RobotState:
        """Take all physics steps that are due at ``now`` [s], and return the measured state."""
        before = now if self._time is None else self._time
        time = max(before, now - _LONGEST_CATCH_UP)
        # If the last torque is too old to act, but servos do not hold the arms yet, the simulation waits for the
        # sender.
        age = now - self._last_command
        if self._tau is not None and _LONGEST_TORQUE < age <= self._hold_after:
            time = min(time + age - _LONGEST_TORQUE, now)
        self.dropped += time - before
        steps = math.floor((now - time) / self._timestep + 1e-6)
        self._time = time + steps * self._timestep
        if steps > 0:
            self._drive(self._time, steps * self._timestep)
        return self.plant.state()

    def _drive(self, now: float, dt: float) -> None:
        # Without this limit, a torque that nobody renews would push for ever.
        if self._tau is not None and now - self._last_command > self._hold_after:
            self._back_to_servos()
        if self._tau is not None:
            state = self.plant.state()
            command = Command(CommandMode.TORQUE, state.q, state.v, self._tau, self._openings)
        else:
            self._follower.advance(now, dt)
            zero = np.zeros(len(self._columns))
            command = Command(CommandMode.POSITION, self._follower.q, self._follower.v, zero, self._openings)
        self.plant.apply(command)
        self.plant.advance(dt)

    def _back_to_servos(self) -> None:
        state = self.plant.state()
        self._follower.stop(state.q, state.v)
        self._tau = None

    def _unusable(self, names: Sequence[str], q: Array, v: Array | None, delay: float) -> str | None:
        """Return the fault of commanded positions, or None."""
        if len(q) != len(names) or (v is not None and len(v) != len(names)):
            return f"{len(q)} positions for {len(names)} joints"
        if not (np.isfinite(q).all() and (v is None or np.isfinite(v).all())):
            return "a number is not finite"
        if not 0.0 <= delay <= 1.0:
            return f"due in {delay:g} s; allowed: 0 .. 1"
        return None

    def _find(self, names: tuple[str, ...]) -> tuple[Array, Array] | str:
        """Return, for the cell's joints in ``names``, their indices in ``names`` and in arrays (nv,).

        If the names cannot be used, the result is a text that says why.
        """
        if len(set(names)) != len(names):
            return "a joint is named twice"
        if not (ours := [place for place, name in enumerate(names) if name in self._columns]):
            return f"none of its joints is one of {', '.join(self._columns)}"[:200]
        return np.array(ours), np.array([self._columns[names[place]] for place in ours])
