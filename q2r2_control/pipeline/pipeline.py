"""What a cell's loop is made of, how it is run, and what a program may ask of a run that goes on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from q2r2_control.config.cell import Config
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.drives.base import permitted
from q2r2_control.drives.factory import make_drive
from q2r2_control.errors import ConfigError
from q2r2_control.events import Reason
from q2r2_control.inputs.base import Input
from q2r2_control.inputs.factory import make_input
from q2r2_control.pipeline.pipeline_run import PipelineRun
from q2r2_control.plants.base import Plant
from q2r2_control.plants.factory import check_mode, make_plant
from q2r2_control.robot.robot import Robot
from q2r2_control.pipeline.loop_clock import LoopClock
from q2r2_control.pipeline.pending_requests import PendingRequests
from q2r2_control.process.signals import few_garbage_collections, stop_on_signals
from q2r2_control.summary.tick import Tick
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.supervision.joint_watch import watch_settings
from q2r2_control.supervision.supervisor import Supervisor
from q2r2_control.supervision.target_stream import StreamSettings
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import CommandMode


class Pipeline:
    """Runs a cell. ``listeners`` are called with every :class:`Tick`; they must not take long.

    Whatever ends a run, the arms are brought to rest before input and plant are closed. A listener that raises is not
    called again; it ends the run like :meth:`stop`, and then its exception goes to the caller. A plant that measures
    what cannot be, or does not follow, ends it with a :class:`PlantError`: see ``supervision``.

    ``realtime``: the loop follows the clock, and a late tick moves no joint farther than a period allows. Otherwise
    time is simulated, as fast as the machine can, and the run is repeatable.
    """

    def __init__(
        self,
        config: Config,
        robot: Robot,
        input: Input,
        plant: Plant,
        mode: CommandMode | str = CommandMode.POSITION,
    ) -> None:
        self.config = config
        self.robot = robot
        self.input = input
        self.plant = plant
        self.drive = make_drive(check_mode(mode, plant), robot, config, CommandMode.POSITION in plant.modes)
        self.controller = CartesianController(robot, permitted(config.control, self.drive))
        self._begin_anew()
        self.listeners: list[Callable[[Tick], None]] = []
        # A plain flag: unlike the locks of threading.Event, a signal handler can set it in the middle of anything.
        self._stopping = False
        self.requests = PendingRequests()

    @classmethod
    def from_config(
        cls,
        config: Config,
        *,
        input: Input | str = "scripted",
        plant: Plant | str = "mujoco",
        mode: CommandMode | str = CommandMode.POSITION,
    ) -> Pipeline:
        """Build a pipeline with an input (``scripted``, ``headset``) and a plant (``mujoco``, ``kinematic``).

        Either may also be an object of one's own. ``mode``: the plant gets joint positions (``position``), velocities
        (``velocity``), or the torques of a Cartesian impedance (``torque``). Raises :class:`ConfigError` for an unknown
        name, and for a mode that the plant does not have.
        """
        robot = Robot.from_config(config)
        return cls(config, robot, make_input(input, config), make_plant(plant, robot, config), mode)

    def stop(self) -> None:
        """Bring the arms to rest and end the run, or the next one if none runs; from any thread or signal handler."""
        self._stopping = True

    def go_home(self) -> None:
        """Bring both arms home, as an operator may; from any thread. Without effect while the arms stop or are stopped.

        Any press of an operator's ends it. How it went is in the events of the run.
        """
        self.requests.home = True

    def change_teleop(self, settings: TeleopSettings) -> None:
        """Other settings of the operator's from the next tick on, without a jump; from any thread.

        What can be changed when: see :meth:`Teleop.change`. Whether it was is in the events of the run; the next run
        begins with the settings of the cell.
        """
        self.requests.settings = settings

    def record_outcome(self, reason: Reason) -> None:
        """Let the operator know what became of the recording or of an episode in it; from any thread."""
        self.requests.of_recording.append(reason)

    def change_control(self, values: Mapping[str, float]) -> None:
        """Other settings of the controller from the next tick on, by name, without a jump; from any thread.

        What can be changed, and how a greater distance comes to count: see :meth:`CartesianController.change`. Whether
        it was is in the events of the run; the next run begins with the settings of the cell. Raises
        :class:`ConfigError` for a name or a value that is not allowed at all.
        """
        self.config.control.changed(values)
        self.requests.control = dict(values)

    def run(self, duration: float | None = None, realtime: bool = True) -> RunSummary:
        """Run for ``duration`` [s], or until :meth:`stop`, Ctrl-C or SIGTERM; the arms are brought to rest first.

        Raises :class:`ConfigError` for a duration that is not positive.
        """
        if duration is not None and not (math.isfinite(duration) and duration > 0.0):
            raise ConfigError(f"duration = {duration!r}: allowed: a positive number of seconds")
        self._prepare(realtime)
        try:
            self.input.start()
            with stop_on_signals(self.stop), few_garbage_collections():
                return self._begin(realtime).until(duration)
        finally:
            self._stopping = False
            self.requests.clear()
            try:
                self.input.close()
            finally:
                self.plant.close()

    def _prepare(self, realtime: bool) -> None:
        """Nothing of an earlier run may move an arm: every run starts paused and with open grippers, as the plant."""
        # Whether a solution is late depends on the machine; a repeatable run must not.
        changes = {} if realtime else {"solve_time_limit": None}
        settings = permitted(self.config.control.model_copy(update=changes), self.drive)
        if settings != self.controller.settings:
            self.controller = CartesianController(self.robot, settings)
        self._begin_anew()

    def _begin(self, realtime: bool) -> PipelineRun:
        """Every run is made here, so that a benchmark can put its clocks into it."""
        return PipelineRun(self, realtime)

    def make_clock(self, realtime: bool) -> LoopClock:
        """The clock of a run, which begins now; a replay has one of its own."""
        return LoopClock(1.0 / self.config.loop_rate_hz, realtime)

    def _begin_anew(self) -> None:
        self.teleop = Teleop(self.config.teleop, tuple(self.robot.arms))
        watch = watch_settings(self.config.supervision, self.drive.yields)
        self.supervisor = Supervisor(
            self.robot,
            self.controller,
            StreamSettings(linked=self.config.teleop.linked),
            watch,
            displace=self.drive.displaced,
        )

    @property
    def stopping(self) -> bool:
        """Whether :meth:`stop` was called, until the run has ended."""
        return self._stopping
