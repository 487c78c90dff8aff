"""Lines outside the certificate that keep arms safe, each with a change that breaks it: see safety_mutations.py.

The lines are in the controller around its kernels, in supervision, and in code that checks the age of data, such as
targets and measured states. Both arms follow one common reference. Other lines make both arms brake if one of them is
too far behind on this reference. Every row names a claim and one line that keeps it.
"""

from __future__ import annotations

from safety_claims import Mutation

CONTROLLER, LIVE = "q2r2_control/control/controller.py", "q2r2_control/control/live_settings.py"
GUARD, OBSTACLES = "q2r2_control/control/solvers/guard.py", "q2r2_control/control/moving_obstacles.py"
SUPERVISION, TELEOP = "q2r2_control/supervision/", "q2r2_control/teleop/"
CLOCK = "q2r2_control/pipeline/loop_clock.py"

CONTROL = (
    Mutation(
        "a solver of another package gets copies of the problem",
        GUARD,
        "self._solver.solve(_copy_of(problem))",
        "self._solver.solve(problem)",
    ),
    Mutation(
        "the time that a solver reports is not trusted",
        GUARD,
        "max(float(solve_time), measured)",
        "float(solve_time)",
    ),
    Mutation(
        "a solver's exception is a failed solve",
        GUARD,
        "except BaseException as error:",
        "except ArithmeticError as error:",
    ),
    Mutation(
        "a solution that comes too late is not used",
        CONTROLLER,
        "solved = solution.v is not None and (limit is None or solution.solve_time <= limit)",
        "solved = solution.v is not None",
    ),
    Mutation(
        "a step that was not proven is not called certified",
        CONTROLLER,
        "self._certified = self._apart and (self._certified if outcome == STOPPED else was_apart)",
        "self._certified = True",
    ),
    Mutation(
        "no tick moves the reference by more than a tick of the longest period",
        CONTROLLER,
        "time = min(float(dt), LONGEST_DT) if usable else 0.0",
        "time = float(dt) if usable else 0.0",
    ),
    Mutation(
        "a step that is undone also undoes the distances that pairs have begun to keep",
        CONTROLLER,
        "self._live.keep_no_more_than(pairs_kept)",
        "pass",
    ),
    Mutation(
        "a step that is undone also undoes the distances that objects have begun to keep",
        CONTROLLER,
        "self._objects.keep_no_more_than(objects_kept)",
        "pass",
    ),
    Mutation(
        "a hard constraint also holds for a solution that the certificate has reduced",
        CONTROLLER,
        "if outcome == REDUCED and not own.permit(state.v):",
        "if False:",
    ),
    Mutation(
        "pairs keep a larger distance only if a stop proves it",
        LIVE,
        "np.maximum(self.kept, np.minimum(np.minimum(self._goal, self.kept + most), room))",
        "np.maximum(self.kept, np.minimum(self._goal, self.kept + most + 0.0 * room))",
    ),
    Mutation(
        "min_distance does not exceed the distance for which the monitored pairs were chosen",
        LIVE,
        "if settings.min_distance > CLEARANCE:",
        "if False:",
    ),
    Mutation(
        "an object that is gripped keeps only a distance that a stop proves",
        LIVE,
        "kept = np.where(self._new, np.minimum(self._goal, self._within_reach()), self.kept)",
        "kept = np.where(self._new, self._goal, self.kept)",
    ),
    Mutation(
        "a step keeps the tools' speed limit",
        "tool_speed.py",
        "if fastest_tool(model, data, i, h) > limits.speed:",
        "if fastest_tool(model, data, i, h) > 1e3:",
    ),
    Mutation(
        "a tool may become faster within a step and its stop",
        "tool_speed.py",
        "return fastest if gained <= fastest else (fastest + gained) ** 2 / (4.0 * gained)",
        "return fastest",
    ),
)

AGES = (
    Mutation(
        "a report of an obstacle is as old as its sender says",
        OBSTACLES,
        "data.age[index] = obstacle.age",
        "data.age[index] = 0.0",
    ),
    Mutation(
        "reports age in a tick that is longer than the longest step",
        CONTROLLER,
        "self._obstacles.pass_time(float(dt) - time)",
        "pass",
    ),
    Mutation("reports age while the arms brake", CONTROLLER, "self._obstacles.pass_time(dt)", "pass"),
    Mutation(
        "reports age by the clock where ticks are late",
        "q2r2_control/loop/control_loop.py",
        "self.controller.pass_time(behind)",
        "pass",
    ),
    Mutation(
        "a report ages until a tick takes it",
        "q2r2_control/pipeline/requests.py",
        'given["age"] += waited',
        "pass",
    ),
    Mutation(
        "arms rest where an obstacle may be that is not reported any more",
        "q2r2_control/control/safety/protective_distance.py",
        "max((stop_time + age) / _SHARE - age, 0.0)",
        "_LEAST_STOP",
    ),
    Mutation(
        "a state that a plant repeats gets older",
        CLOCK,
        "replace(state, stamp=now - self._unanswered)",
        "replace(state, stamp=now)",
    ),
    Mutation(
        "a hand's pose that is too old is not followed",
        TELEOP + "gate.py",
        "return now - self.stamp > self.settings.timeout",
        "return False",
    ),
    Mutation(
        "a stamp from the future does not keep a pose fresh",
        TELEOP + "gate.py",
        "stamp = min(float(sample.pose_stamp), now)",
        "stamp = float(sample.pose_stamp)",
    ),
    Mutation(
        "a hand that comes back after a gap is not followed on",
        TELEOP + "gate.py",
        "if gap > limits.timeout:",
        "if False:",
    ),
    Mutation(
        "a stream of targets that has run dry ends",
        SUPERVISION + "target_stream.py",
        "if self._last is None or now - self.stamp <= self._settings.timeout:",
        "if True:",
    ),
    Mutation(
        "measured states that are too old stop the arms",
        SUPERVISION + "joint_watch.py",
        "if not -timeout <= age <= timeout:",
        "if age < -timeout:",
    ),
    Mutation(
        "a clock that was set back does not keep states fresh",
        SUPERVISION + "joint_watch.py",
        "if not -timeout <= age <= timeout:",
        "if age > timeout:",
    ),
    Mutation(
        "arms are not activated by old states",
        SUPERVISION + "joint_watch.py",
        "return fresh and now - self._still_since >= self._settings.settle_time",
        "return now - self._still_since >= self._settings.settle_time",
    ),
    Mutation(
        "a target that was sent long ago is not followed",
        SUPERVISION + "targets.py",
        "if delay - usual <= self._allowed:",
        "if True:",
    ),
)

WATCHES = (
    Mutation(
        "arms are activated at rest",
        SUPERVISION + "joint_watch.py",
        "return fresh and now - self._still_since >= self._settings.settle_time",
        "return fresh",
    ),
    Mutation(
        "a measured joint that jumps stops the arms",
        SUPERVISION + "joint_watch.py",
        "if far and (fault := self._jump(",
        "if False and (fault := self._jump(",
    ),
    Mutation(
        "measured states that are not finite stop the arms",
        SUPERVISION + "joint_watch.py",
        "if now - self._stamp > self._settings.unusable_time:",
        "if False:",
    ),
    Mutation(
        "arms that do not follow their reference stop",
        SUPERVISION + "joint_watch.py",
        "if now - self._near_at <= self._settings.deviation_time:",
        "if True:",
    ),
    Mutation(
        "arms of another controller stop if measured pairs are too close",
        SUPERVISION + "joint_watch.py",
        "if (distances - kept).min(initial=np.inf) >= -self._settings.tolerance:",
        "if True:",
    ),
    Mutation(
        "an arm of another controller that is left behind is found",
        SUPERVISION + "joint_watch.py",
        "elif now - self._near_at[arm] > self._watch.deviation_time:",
        "elif False:",
    ),
    Mutation(
        "a reset waits until the arms rest",
        SUPERVISION + "supervisor.py",
        "if self.phase is Phase.BRAKING:\n            return Reason(SupervisionReason.ARMS_BRAKING)",
        "",
    ),
    Mutation(
        "arms brake until they rest",
        SUPERVISION + "supervisor.py",
        "elif float(np.abs(reference.v).max()) <= _REST:",
        "else:",
    ),
    Mutation(
        "the reference begins at a held posture, not at the measured one",
        SUPERVISION + "supervisor.py",
        "self._controller.reset(state.q if state.held is None else state.held)",
        "self._controller.reset(state.q)",
    ),
    Mutation(
        "arms whose loop stood still do not go on",
        SUPERVISION + "supervisor.py",
        "if self.phase not in (Phase.ACTIVE, Phase.BRAKING):",
        "if True:",
    ),
    Mutation(
        "a stream that begins away from the tool is refused",
        SUPERVISION + "target_stream.py",
        "if begins and distance <= self._settings.engage_distance and angle",
        "if begins and angle",
    ),
    Mutation(
        "a stream that was refused is not followed because it passes the tool",
        SUPERVISION + "target_stream.py",
        "if begins and distance <=",
        "if distance <=",
    ),
    Mutation(
        "two publishers of one hand's targets are found",
        SUPERVISION + "targets.py",
        "self._breaks.append(now)",
        "pass",
    ),
    Mutation(
        "linked arms hold together",
        SUPERVISION + "targets.py",
        "if self._settings.linked and arm != ended and stream.following:",
        "if False:",
    ),
    Mutation(
        "a late tick moves no joint farther than its limit allows in a period",
        SUPERVISION + "tick_pacer.py",
        "step = min(gap, LONGEST_DT if self._coasts else max(self.period, float(longest.min())))",
        "step = gap",
    ),
    Mutation(
        "a gripper goes no farther open than was proven",
        SUPERVISION + "gripper_limiter.py",
        "if free or accepted:",
        "if True:",
    ),
)

TWO_ARMS = (
    Mutation(
        "the window grows no faster than time passes",
        "reference_history.py",
        "history.window[0] = min(history.window[1], history.window[0] + h)",
        "history.window[0] = history.window[1]",
    ),
    Mutation(
        "an arm that lags makes both arms brake",
        SUPERVISION + "arm_skew.py",
        "self.holds = self._skew > self._allowed or self._one_is_silent(timings)",
        "self.holds = self._one_is_silent(timings)",
    ),
    Mutation(
        "an arm that is silent makes both arms brake",
        SUPERVISION + "arm_skew.py",
        "self.holds = self._skew > self._allowed or self._one_is_silent(timings)",
        "self.holds = self._skew > self._allowed",
    ),
    Mutation(
        "both arms brake while one is behind",
        SUPERVISION + "supervisor.py",
        "if self.phase is not Phase.ACTIVE or self.skew.holds:",
        "if self.phase is not Phase.ACTIVE:",
    ),
    Mutation(
        "arms that stay apart in time are activated anew",
        SUPERVISION + "supervisor.py",
        "elif apart := self.skew.fault(now):",
        "elif (apart := self.skew.fault(now)) and False:",
    ),
    Mutation(
        "the window has room for the answer that an arm has not heard",
        SUPERVISION + "arm_skew.py",
        "return allowed_skew(timings) + 2.0 * max(timing.period for timing in timings.values()) + lead",
        "return allowed_skew(timings) + lead",
    ),
    Mutation(
        "a lag is found if the driver reports none",
        SUPERVISION + "measured_lags.py",
        "times[off <= off.min() + _SAME_FIT], 0.0)",
        "times[off <= off.min() + _SAME_FIT], 0.0) * 0.0",
    ),
    Mutation(
        "linked arms that a policy's fault stopped begin together",
        TELEOP + "policy_side.py",
        "if not ready or (self._linked and not self._wanted().issubset(ready)):",
        "if not ready:",
    ),
    Mutation(
        "a controller that stands still is found",
        SUPERVISION + "standstill.py",
        "return way if stands and now - self._since >= needed else None",
        "return None",
    ),
)

COMMANDS = (
    Mutation(
        "a mean has enough references for the limit of jerk",
        "q2r2_control/drives/command_average.py",
        "count = max(math.ceil((window - _ROUNDING) / period), 1)",
        "count = max(math.floor(window / period) - 1, 1)",
    ),
    Mutation(
        "a mean is not taken over a late tick",
        "q2r2_control/drives/command_average.py",
        "if not self._path or dt > self._longest:",
        "if not self._path:",
    ),
    Mutation(
        "the joint with the least limit decides the window",
        "q2r2_control/robot/command_average.py",
        "joint = int(np.argmax(windows))",
        "joint = int(np.argmin(windows))",
    ),
    Mutation(
        "pairs keep as much more distance as a mean may be off",
        "q2r2_control/robot/command_average.py",
        "off = 0.25 * window**2",
        "off = 0.0 * window**2",
    ),
    Mutation(
        "a plant that stops by itself and does not average is refused",
        "q2r2_control/plants/base.py",
        "return mode is CommandMode.TORQUE or not isinstance(plant, SessionPlant) or",
        "return True or",
    ),
)
