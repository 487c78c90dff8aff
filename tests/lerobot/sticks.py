"""The gamepad of lerobot without pygame: a test sets sticks and buttons. lerobot finds it by its config's name."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.teleoperators import TeleoperatorConfig
from lerobot.teleoperators.gamepad import GamepadTeleop, GamepadTeleopConfig
from lerobot.teleoperators.gamepad.gamepad_utils import InputController


class StillController(InputController):
    """What lerobot reads instead of a joystick."""

    deltas = (0.0, 0.0, 0.0)

    def get_deltas(self) -> tuple[float, float, float]:
        return self.deltas


@TeleoperatorConfig.register_subclass("sticks")
@dataclass
class SticksConfig(GamepadTeleopConfig): ...


class Sticks(GamepadTeleop):
    """The gamepad."""

    config_class = SticksConfig
    name = "sticks"
    sticks = StillController()

    def connect(self) -> None:
        self.gamepad = self.sticks
