"""A cell whose cabinets send to free ports of this computer."""

from __future__ import annotations

import socket

import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.fri import CabinetConfig
from q2r2_control.types import SIDES

PATIENCE = 30.0  # [s]


def free_ports(count: int) -> list[int]:
    opened = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for one in opened:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in opened]
    for one in opened:
        one.close()
    return ports


@pytest.fixture
def fri_config(config: Config) -> Config:
    ports = free_ports(2)
    cabinets = {arm: CabinetConfig(port=port) for arm, port in zip(SIDES, ports, strict=True)}
    return config.model_copy(update={"fri": cabinets})
