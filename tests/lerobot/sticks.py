"""lerobot's gamepad without pygame. A test sets its sticks and buttons. lerobot finds it by the name of its config."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.teleoperators import TeleoperatorConfig
from lerobot.teleoperators.gamepad import GamepadTeleop, GamepadTeleopConfig
from lerobot.teleoperators.gamepad.gamepad_utils import InputController


class StillController(InputController):
    """A replacement for the joystick that lerobot reads."""

    deltas = (0.0, 0.0, 0.0)

    def get_deltas(self) -> tuple[float, float, float]:
        return self.deltas


@TeleoperatorConfig.register_subclass("sticks")
@dataclass
class SticksConfig(GamepadTeleopConfig): ...


class Sticks(GamepadTeleop):
    """lerobot's gamepad, which reads :attr:`sticks` instead of a joystick."""

    config_class = SticksConfig
    name = "sticks"
    sticks = StillController()

    def connect(self) -> None:
        self.gamepad = self.sticks
