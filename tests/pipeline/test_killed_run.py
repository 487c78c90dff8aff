"""A process that moves the arms is killed during a motion, with real processes and sockets."""

from __future__ import annotations

import socket
from collections.abc import Callable
from threading import Thread
from typing import Any

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.fri import CabinetConfig
from q2r2_control.errors import PlantError
from q2r2_control.pipeline import killed_run
from q2r2_control.pipeline.killed_run import main, measure_kill
from q2r2_control.pipeline.slow_run import Moment
from q2r2_control.plants.fri.cabinet import Trip
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES
from tests.pipeline.slow_cell import slow_run
from tests.plants.fri.conftest import free_ports
from tests.plants.fri.waiting_cabinets import waiting_cabinets


@pytest.fixture
def config() -> Config:
    cabinets = {arm: CabinetConfig(port=port) for arm, port in zip(SIDES, free_ports(2), strict=True)}
    return load_config("config/dual_iiwa7_fri.yaml").model_copy(update={"fri": cabinets})


@pytest.mark.slow
def test_arms_of_a_killed_run_come_to_rest_within_their_certified_stop(config: Config) -> None:
    with waiting_cabinets(Robot.from_config(config), config) as cabinets:
        reports = measure_kill(config, lambda: np.concatenate([cabinets[arm].arm.q for arm in SIDES]), led=0.3)
    for report in reports:
        assert set(cabinets[report.arm].trips) <= {Trip.LATE}  # A cabinet whose client is killed ends the session.
        assert 0.0 < report.stopped_mm < report.allowed_mm


class LeadingThread:
    """A replacement for :class:`HelperProcess`, which moves arms behind virtual cabinets in simulated time."""

    def __init__(self, what: str, module: str, on_answer: Callable[[Moment], None]) -> None:
        self.fault: str | None = None
        self.killed_too_early = False
        self._on_answer = on_answer

    def send(self, config: Config) -> None:
        self._thread = Thread(target=self._lead, args=(config,))
        self._thread.start()

    def _lead(self, config: Config) -> None:
        try:
            main(iter((config,)), self._on_answer)
        except PlantError as error:
            self.fault = str(error)

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def kill(self) -> None:
        self.killed_too_early = self.alive
        self._thread.join()


@pytest.mark.slow
def test_if_the_arms_hardly_rise_the_run_is_not_killed_and_the_error_asks_for_free_space_above_them(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = config.model_copy(update={"control": config.control.model_copy(update={"max_linear_speed": 0.005})})
    led: list[LeadingThread] = []

    def leads(*arguments: Any) -> LeadingThread:
        led.append(LeadingThread(*arguments))
        return led[-1]

    monkeypatch.setattr(killed_run, "HelperProcess", leads)
    monkeypatch.setattr(killed_run, "SlowRun", lambda config, plant, listener: slow_run(config, listener=listener))
    with pytest.raises(PlantError, match="100 mm of room above it"):
        measure_kill(slow, lambda: np.zeros(14), led=0.3)
    assert not led[0].killed_too_early


@pytest.mark.slow
def test_a_run_that_cannot_begin_raises_an_error_with_the_reason(config: Config) -> None:
    port = config.fri["left"].port
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", port))
        with pytest.raises(PlantError, match=rf"fri\.left\.port = {port}: cannot be bound"):
            measure_kill(config, lambda: np.zeros(14))
