"""The whole loop against two cabinets in virtual time: the messages that each cabinet gets in all circumstances."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.fri import GripperIoConfig
from q2r2_control.control.controller import CartesianController
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.fri.answers import ReferencePath
from q2r2_control.plants.fri.cabinet import Cabinet, Trip
from q2r2_control.plants.fri.cabinet_server import SimulatedArm, SimulatedArms
from q2r2_control.plants.fri.reasons import FriReason
from q2r2_control.plants.fri.wire import Joints, Session, joints_of
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.summary.tick import Tick
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import SIDES, CommandMode
from tests.pipeline.loops import FreezingLoop, when_moving
from tests.plants.fri.soak import ACCELERATION, Soak, make_loop
from tests.plants.fri.virtual_cabinets import VirtualCabinets


@pytest.fixture(scope="session")
def config(config: Config) -> Config:
    """Return the cell at the rate of the shipped cell with cabinets."""
    return config.model_copy(update={"loop_rate_hz": 500.0})


def started(pipeline: FreezingLoop) -> VirtualCabinets:
    """Return a cell in which the operator has started the overlay on both pendants."""
    assert isinstance(pipeline.plant, VirtualCabinets)
    for cabinet in pipeline.plant.cabinets.values():
        cabinet.start_overlay()
    return pipeline.plant


def trips(plant: VirtualCabinets) -> list[Trip]:
    return [trip for cabinet in plant.cabinets.values() for trip in cabinet.trips]


def error(summary: RunSummary, arm: str) -> float:
    """Return the error from target to measured tool [mm RMS]."""
    found = summary.arms[arm].position_error_mm_rms
    assert found is not None
    return found


@pytest.mark.slow
def test_a_run_waits_for_the_cabinets_and_refuses_presses_until_then(config: Config) -> None:
    pipeline = make_loop(config)
    told: dict[str, str] = {}
    pipeline.listeners.append(lambda tick: told.update(tick.sessions))
    summary = pipeline.run(1.0, realtime=False)
    events = summary.events
    assert summary.broken
    assert told == dict.fromkeys(SIDES, "monitoring ready, connection excellent, drives off")
    assert {event.reason.root.kind for event in events} == {FriReason.FRI_SESSION}
    assert {event.kind for event in events} == {TeleopReason.NOT_ENGAGED}


@pytest.mark.slow
def test_an_activation_is_reported_without_a_warning(config: Config, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    pipeline = make_loop(config)
    started(pipeline)
    pipeline.run(1.0, realtime=False)
    told = [entry.levelname for entry in caplog.records if entry.getMessage() == SupervisionReason.ACTIVATED.template]
    assert told == ["INFO"]


@pytest.mark.slow
def test_lost_messages_are_reported_once_per_run_for_each_cabinet(
    config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    pipeline = make_loop(config)
    plant = started(pipeline)
    for loss, said in ((0.0, []), (0.1, sorted(SIDES)), (0.1, sorted(SIDES))):
        caplog.clear()
        plant._loss = loss
        pipeline.run(1.0, realtime=False)
        lines = [entry.getMessage() for entry in caplog.records]
        assert sorted(line.partition(":")[0] for line in lines if "10 messages lost and 0 unreadable" in line) == said


@pytest.mark.slow
def test_a_cabinet_without_the_grippers_output_is_named_once_and_no_output_is_written(
    config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    pipeline = make_loop(config, grippers=dict.fromkeys(SIDES, GripperIoConfig(output="Gripper.Opening")))
    assert isinstance(pipeline.plant, VirtualCabinets)
    whole = pipeline.plant.cabinets["left"]
    pipeline.plant.cabinets["left"] = Cabinet(whole.settings, whole.arm)
    plant = started(pipeline)
    pipeline.run(1.0, realtime=False)
    told = [entry.getMessage() for entry in caplog.records if "Gripper.Opening" in entry.getMessage()]
    lacks = "has no analog output Gripper.Opening, so that the gripper is not commanded"
    assert told == [f"left: cabinet {lacks}; outputs that its application registers: none"]
    assert trips(plant) == []
    assert all(cabinet.session is Session.COMMANDING_ACTIVE for cabinet in plant.cabinets.values())


@pytest.mark.slow
@pytest.mark.parametrize(
    "network",
    [
        pytest.param({"drift": 200e-6, "jitter": 0.0005}, id="drift"),
        pytest.param({"drift": -200e-6, "jitter": 0.0005, "loss": 0.005}, id="loss"),
    ],
)
def test_a_network_with_drift_jitter_and_loss_ends_no_session(config: Config, network: dict[str, Any]) -> None:
    pipeline = make_loop(config, (0.005, 0.002), **network)
    plant = started(pipeline)
    summary = pipeline.run(2.5, realtime=False)
    assert trips(plant) == []
    assert all(summary.arms[arm].engaged_s > 1.5 for arm in SIDES)


@pytest.mark.slow
def test_if_the_loop_freezes_for_20_ms_the_arms_brake_as_certified_and_then_go_on(config: Config) -> None:
    pipeline = make_loop(config)
    plant = started(pipeline)

    def freeze(tick: Tick) -> None:
        pipeline.freeze(0.02 if round(1e3 * tick.now) % 100 == 0 else 0.0)

    pipeline.listeners.append(freeze)
    summary = pipeline.run(2.5, realtime=False)
    assert trips(plant) == []
    assert all(summary.arms[arm].engaged_s > 1.5 for arm in SIDES), "and the arms go on"


@pytest.mark.slow
@pytest.mark.parametrize(("latest", "thinks", "bound"), [(0.007, False, 1.3), (0.01, True, 2.0)])
def test_a_loop_with_only_late_ticks_follows_nearly_as_well_as_a_punctual_loop(
    config: Config, latest: float, thinks: bool, bound: float
) -> None:
    """Ticks are up to ``latest`` [s] late. If ``thinks`` is True, their commands are late as well."""

    def run(most: float) -> float:
        pipeline = make_loop(config, (0.002, 0.002), jitter=0.0004)
        plant, random = started(pipeline), np.random.default_rng(0)

        def freeze(_: Tick) -> None:
            late = float(random.uniform(0.0, most))
            plant.thinking = thinks * late
            pipeline.freeze(late)

        pipeline.listeners.append(freeze)
        summary = pipeline.run(3.0, realtime=False)
        assert trips(plant) == []
        return error(summary, "left")

    assert run(latest) < bound * run(0.0)


def test_each_tick_advances_the_reference_by_one_period_until_the_loop_knows_that_a_session_follows(
    config: Config,
) -> None:
    plant = started(make_loop(config))
    plant.reset()
    for tick in range(100):  # In the previous session, the loop's commands came too late.
        plant.cell.sent(taken=False)
        assert plant.due(0.002 * tick) == pytest.approx((0.0, 0.002))


@pytest.mark.slow
def test_a_command_that_came_too_late_for_its_answers_is_withdrawn_and_the_arms_go_on(config: Config) -> None:
    pipeline = make_loop(config, jitter=0.0005)
    plant, random, period = started(pipeline), np.random.default_rng(0), 1.0 / config.nominal_rate_hz
    withdrawn: list[bool] = []
    pieces: list[tuple[float, np.ndarray, np.ndarray]] = []

    def think(tick: Tick) -> None:
        withdrawn.append(plant.withdraws())
        pieces.append((tick.step, tick.reference.q, tick.reference.v))
        plant.thinking = 0.02 * random.random() if random.random() < 0.03 else 0.0
        pipeline.freeze(max(plant.thinking - period, 0.0))

    pipeline.listeners.append(think)
    summary = pipeline.run(4.0, realtime=False)
    assert sum(withdrawn) > 10
    assert trips(plant) == []
    for arm in SIDES:
        assert summary.arms[arm].engaged_s > 3.0, "no arm is paused for it"
        assert error(summary, arm) < 20.0, "and the tools follow"
    for (_, q, v), (step, to, speed) in pairwise(pieces):
        assert (np.abs(speed - v) <= ACCELERATION * step + 1e-9).all()
        assert (np.abs(to - q - 0.5 * step * (speed + v)) <= 0.5 * ACCELERATION * step**2 + 1e-9).all()


@pytest.mark.slow
def test_arms_go_on_even_if_each_tick_takes_longer_than_the_loop_expects(config: Config) -> None:
    pipeline = make_loop(config)
    plant = started(pipeline)

    def think(tick: Tick) -> None:
        plant.thinking = 0.008 if tick.now > 1.0 else 0.0
        pipeline.freeze(0.006 if tick.now > 1.0 else 0.0)

    pipeline.listeners.append(think)
    summary = pipeline.run(2.5, realtime=False)
    assert trips(plant) == []
    assert FriReason.FRI_OVERTAKEN not in {event.reason.root.kind for event in summary.events}
    for arm in SIDES:
        assert summary.arms[arm].engaged_s > 1.5


@pytest.mark.slow
def test_arms_rest_on_their_certified_stop_while_a_solver_blocks_and_go_on_afterwards(config: Config) -> None:
    blocks, begins_within, period = 0.2, 0.015, 0.005
    pipeline = make_loop(config, (period, period))
    plant = started(pipeline)
    sent: dict[str, list[tuple[float, Joints]]] = {arm: [] for arm in SIDES}
    plant.on_message = lambda arm, t: sent[arm].append((t, plant.cabinets[arm].commanded))
    newest: list[Tick] = []  # Contains the tick before the tick in which the solver blocks.
    decelerations: list[np.ndarray] = []

    def block(tick: Tick) -> None:
        if plant.thinking > 0.0:
            plant.thinking = 0.0
            pipeline.freeze(blocks)
        elif not newest and np.abs(tick.reference.v).max() > 0.4:
            newest.append(tick)
            decelerations.append(np.array(tick.command.deceleration))
            plant.thinking = blocks

    pipeline.listeners.append(block)
    summary = pipeline.run(3.0, realtime=False)
    assert trips(plant) == []
    begin, rest = newest[0].now, float((np.abs(newest[0].reference.v) / decelerations[0]).max())
    assert begins_within + rest < 0.8 * blocks
    for arm in SIDES:
        speeds = {t: np.subtract(now, before) / period for (_, before), (t, now) in pairwise(sent[arm])}
        fastest = [float(np.abs(v).max()) for t, v in speeds.items() if begin + begins_within < t < begin + blocks]
        assert (np.diff(fastest) < 1e-6).all(), "it gets slower from then on"
        late = [
            np.abs(v).max() for t, v in speeds.items() if begin + begins_within + period + rest < t < begin + blocks
        ]
        assert len(late) > 10
        assert max(late) < 1e-6, "and stands still for the rest of the time"
        assert summary.arms[arm].engaged_s > 2.0


@pytest.mark.slow
def test_a_loop_that_is_always_too_late_is_reported(config: Config) -> None:
    pipeline = make_loop(config)
    plant = started(pipeline)

    def think(tick: Tick) -> None:
        late = tick.now > 2.0
        plant.thinking = 0.02 if late else 0.0
        pipeline.freeze(0.02 if late else 0.0)

    pipeline.listeners.append(think)
    events = pipeline.run(3.0, realtime=False).events
    assert trips(plant) == []
    assert FriReason.FRI_OVERTAKEN in {event.reason.root.kind for event in events}


@pytest.mark.slow
@pytest.mark.parametrize("mode", [CommandMode.POSITION, CommandMode.TORQUE])
def test_arms_behind_cabinets_follow_as_well_as_arms_without_cabinets(config: Config, mode: CommandMode) -> None:
    robot = Robot.from_config(config)
    pipeline = make_loop(config, mode=mode, jitter=0.0005, arms=SimulatedArms(robot, config))
    plant = started(pipeline)
    summary = pipeline.run(2.5, realtime=False)
    hands, direct_arms = ScriptedInput("circle", frequency_hz=0.5), MujocoPlant(pipeline.robot, config)
    direct = Pipeline(pipeline.config, pipeline.robot, hands, direct_arms, mode).run(2.5, realtime=False)
    assert trips(plant) == []
    for arm in SIDES:
        assert plant.cabinets[arm].session is Session.COMMANDING_ACTIVE
        assert summary.arms[arm].engaged_s > 1.5
        assert error(summary, arm) < 1.3 * error(direct, arm)


class ShiftedArm(SimulatedArm):
    """An arm whose joints are measured ``shift`` [rad] away from their true positions."""

    shift = 0.0

    @property
    def q(self) -> Joints:
        return joints_of(np.add(super().q, self.shift))


@pytest.mark.slow
def test_if_the_measured_state_is_not_trusted_the_arms_are_braked_at_every_tick(config: Config, robot: Robot) -> None:
    arms = SimulatedArms(robot, config)
    arms.arms["left"] = left = ShiftedArm(arms, "left")
    pipeline = make_loop(config, mode=CommandMode.TORQUE, jitter=0.0004, arms=arms)
    plant = started(pipeline)
    brakings: list[list[float]] = []

    def look(tick: Tick) -> None:
        fastest, believed = float(np.abs(arms.state.v).max()), pipeline.supervisor.measured
        if not believed and brakings:
            brakings[-1].append(fastest)
        elif fastest > 0.5 and (not brakings or brakings[-1]):
            brakings.append([])
            left.shift = 0.3 - left.shift

    pipeline.listeners.append(look)
    pipeline.run(5.0, realtime=False)
    assert trips(plant) == []
    assert len(brakings) > 4
    for speeds in brakings[:-1]:
        assert max(speeds) < speeds[0] + 0.2, "a jump of what is measured is hardly a push"
        # After 20 ticks, the current period of each cabinet is over, and the filtered velocity contains no jump.
        later = np.array(speeds[20:])
        assert (np.diff(later) < 0.01 * later[:-1] + 1.0 / config.nominal_rate_hz).all(), "no arm gets faster"
        assert later[-1] < 0.02, "and both rest before they are believed again"


def test_the_controllers_reference_brakes_like_the_path_from_which_cabinets_are_answered(robot: Robot) -> None:
    controller = CartesianController(robot)
    target = controller.tool_pose("left")
    target.translation = target.translation + np.array([0.1, 0.1, 0.1])
    for _ in range(300):
        reference = controller.step({"left": target}, 0.001)
    assert np.abs(reference.v).max() > 0.2
    path = ReferencePath(0.0, reference.q)
    path.extend(0.001, reference.q, reference.v, controller.stop_deceleration)
    before = 0.001
    for t in (0.005, 0.05, 0.4):
        controller.brake(t - before)
        before = t
        np.testing.assert_allclose(controller.step({}, 1e-9).q, path.at(t), atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [CommandMode.POSITION, CommandMode.TORQUE])
def test_arms_do_not_jump_however_sessions_end_and_every_session_begins_again(
    config: Config, mode: CommandMode
) -> None:
    soak = Soak(make_loop(config, mode=mode, jitter=0.0004, drift=200e-6), sessions=4, seed=1).run()
    assert soak.ended == 4
    assert soak.moved > 0.3
    assert soak.faults == []


def test_the_fault_of_a_cabinet_is_the_reason_why_its_arm_and_the_other_arm_pause(config: Config) -> None:
    pipeline = make_loop(config)
    plant = started(pipeline)
    pipeline.listeners.append(when_moving(plant.cabinets["left"].stop))
    summary = pipeline.run(2.0, realtime=False)
    pauses = {event.arm: str(event.kind) for event in summary.events if event.source == "engaged"}
    assert pauses == {"left": FriReason.FRI_SESSION, "right": FriReason.FRI_SESSION}


def test_the_first_command_of_a_session_is_the_posture_in_which_the_cabinet_holds_its_arm(config: Config) -> None:
    pipeline = make_loop(config)
    plant = started(pipeline)
    assert pipeline.run(0.6, realtime=False).at_rest
    for arm in SIDES:
        home = pipeline.robot.home[pipeline.robot.arms[arm].joints]
        np.testing.assert_allclose(plant.heard[arm][0], home, atol=1e-6)


def test_an_arm_beyond_its_position_margin_moves_back_inside(config: Config, robot: Robot) -> None:
    margin, start = config.control.position_margin, robot.home.copy()
    joint = int(robot.arms["left"].joints[6])
    start[joint] = robot.position_upper[joint] - 0.3 * margin
    pipeline = make_loop(config, start=start)
    plant = started(pipeline)
    pipeline.run(0.8, realtime=False)
    assert trips(plant) == []
    assert plant.heard["left"][0][6] == pytest.approx(start[joint], abs=1e-4)
    assert plant.heard["left"][-1][6] <= robot.position_upper[joint] - margin + 1e-4
