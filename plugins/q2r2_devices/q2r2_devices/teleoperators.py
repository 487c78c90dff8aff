"""Teleoperators of lerobot as hands: leader arms, and rate devices such as gamepads.

An arm follows its hand only while a dead man's switch is held. A gamepad or keyboard of lerobot says by itself whether
the person intervenes. A leader arm has no button, and both hands of the person hold leaders, so a pedal is the switch.
A gesture of the gripper's handle cannot be the switch. To pause by a double squeeze, the person would have to open the
handle, so the gripper would open and drop the object that it holds.
"""

from __future__ import annotations

import pkgutil
import time
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from inspect import signature
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from q2r2_control import (
    Array,
    Config,
    ConfigError,
    DeviceControls,
    DeviceWords,
    HandInputs,
    HandSample,
    InputError,
    StrictModel,
)
from q2r2_devices.leader import LeaderArm, LeaderSettings, number_of, trigger_of
from q2r2_devices.pedal import Pedal
from q2r2_devices.rate import RateHand, RateReading
from q2r2_devices.reading import DeviceInput, DeviceReader, Say, tell

_WHERE = "input_settings.lerobot"
_PERIOD = 1.0 / 75.0  # Shortest time between two readings of a teleoperator [s].
_DELTAS = ("delta_x", "delta_y", "delta_z")
_CLOSE, _STAY = 0, 1  # Values of lerobot's action ``gripper``. The value 2 opens the gripper.
_WORDS = DeviceWords(
    nouns={"grip": "the pedal, or the device's own button to intervene", "trigger": "the gripper's handle"},
    verbs={"grip": "hold"},
    absent="nothing: a teleoperator or the pedal is not connected",
)


class TeleoperatorSettings(StrictModel):
    """The settings of one hand."""

    teleoperator: dict[str, Any] = Field(description="the settings that lerobot's --teleop has, such as type and port")
    leader: LeaderSettings | None = Field(None, description="kinematics of a leader arm; null: a rate device")
    speed: float = Field(0.2, gt=0, le=1, description="speed of the hand of a rate device at full deflection [m/s]")


class LerobotSettings(StrictModel):
    """The settings of ``input_settings.lerobot``. A hand that is null has no teleoperator."""

    pedal: str | None = Field(None, description="event device that engages the arms while one of its keys is held")
    left: TeleoperatorSettings | None = None
    right: TeleoperatorSettings | None = None


def lerobot_cell(config: Config) -> Config:
    """Return the cell in which the dead man's switch engages an arm, and the handle moves the gripper."""
    changes = {"lower": "none", "upper": "none", "grip": "dead_man", "trigger": "gripper_analog"}
    bindings = config.teleop.bindings.model_validate(changes)
    return config.model_copy(update={"teleop": config.teleop.model_copy(update={"bindings": bindings})})


class LeaderReading(NamedTuple):
    """The pose of a leader's tool, and its gripper as the trigger."""

    position: Array  # (3,) [m]
    quaternion: Array  # (4,) x y z w
    inputs: HandInputs


class Teleoperator:
    """A teleoperator of lerobot, as a :class:`~q2r2_devices.reading.Device`.

    Args:
        settings: The settings of the hand.
        has_pedal: Whether a pedal engages the arm. Otherwise the teleoperator needs a switch of its own.
    """

    def __init__(self, settings: TeleoperatorSettings, has_pedal: bool) -> None:
        self._settings, self._has_pedal = settings, has_pedal
        self._device: Any = None
        self._trigger = 0.0

    def open(self) -> str:
        self._device = _made(self._settings.teleoperator)
        if not self._has_pedal and not hasattr(self._device, "get_teleop_events"):
            raise ConfigError(
                f"{self._device.name} has no switch that engages an arm; "
                f"allowed: {_WHERE}.pedal, an event device such as /dev/input/by-id/usb-...-event-kbd"
            )
        names = list(self._device.action_features.get("names", self._device.action_features))
        if self._settings.leader is not None:
            self._leader = LeaderArm(self._settings.leader, names)
        elif missing := [name for name in _DELTAS if name not in names]:
            raise ConfigError(f"{self._device.name} gives no {missing[0]}; allowed for a leader arm: the block leader")
        asks = "calibrate" in signature(self._device.connect).parameters
        self._device.connect(**({"calibrate": False} if asks else {}))
        if asks and not self._device.is_calibrated:
            kind = self._settings.teleoperator["type"]
            raise InputError(f"{self._device} is not calibrated; allowed: lerobot-calibrate --teleop.type={kind} ...")
        return str(self._device)

    def read(self) -> RateReading | LeaderReading:
        time.sleep(_PERIOD)
        action, held = self._device.get_action(), False
        if not self._has_pedal:
            held = any(on for event, on in self._device.get_teleop_events().items() if event.value == "is_intervention")
        if self._settings.leader is not None:
            return LeaderReading(*self._leader.tool(action), HandInputs(press_index=trigger_of(action)))
        if (gripper := int(action.get("gripper", _STAY))) != _STAY:
            self._trigger = float(gripper == _CLOSE)
        deltas = np.clip([number_of(action, name) for name in _DELTAS], -1.0, 1.0)
        velocity = np.concatenate([self._settings.speed * deltas, np.zeros(3)])
        return RateReading(velocity, HandInputs(press_index=self._trigger, press_middle=float(held)))

    def close(self) -> None:
        if self._device is not None and self._device.is_connected:
            self._device.disconnect()


def _made(settings: dict[str, Any]) -> Any:
    """Return the teleoperator of lerobot with these settings, which is not connected yet.

    Raises:
        InputError: If lerobot is not installed.
        ConfigError: If lerobot has no such teleoperator.
    """
    try:
        import draccus
        import lerobot.teleoperators as known
        from lerobot.utils.import_utils import register_third_party_plugins
    except ImportError as error:
        raise InputError("lerobot is not installed; allowed: make lerobot") from error
    # A type is known after its module was imported. The modules whose own packages are missing are left out.
    for module in pkgutil.iter_modules(known.__path__, f"{known.__name__}."):
        with suppress(Exception):
            import_module(module.name)
    register_third_party_plugins()
    choices = known.TeleoperatorConfig.get_known_choices()
    if settings.get("type") not in choices:
        raise ConfigError(f"teleoperator.type = {settings.get('type')}: allowed: {', '.join(sorted(choices))}")
    return known.make_teleoperator_from_config(draccus.decode(known.TeleoperatorConfig, settings))


def _check_different(hands: dict[str, TeleoperatorSettings]) -> None:
    """Raise :class:`ConfigError` if one teleoperator would move both arms."""
    left, right = (hands[hand].teleoperator if hand in hands else {} for hand in ("left", "right"))
    port = right.get("port")
    if left and (left == right or (port is not None and left.get("port") == port)):
        what = "teleoperator" if port is None else f"teleoperator.port = {port}"
        raise ConfigError(f"{_WHERE}.right.{what}: the same as of the left hand; allowed: another one for each hand")


class LeaderHand:
    """The hand at a leader arm. It has one sample for each reading."""

    def __init__(self, hand: str) -> None:
        self._hand = hand

    def poll(self, readings: list[LeaderReading | None], now: float) -> list[HandSample]:
        """Return the newest reading as one sample. Return no sample if no reading came, or if the leader was lost."""
        newest = readings[-1] if readings else None
        if newest is None:
            return []
        return [HandSample(self._hand, newest.position, newest.quaternion, now, newest.inputs, now)]


class LerobotInput(DeviceInput):
    """One or two teleoperators of lerobot as hands. Implements :class:`~q2r2_control.Input`."""

    settings = LerobotSettings
    controls = DeviceControls(buttons=(), axes=("press_index", "press_middle"), words=_WORDS)
    cell = staticmethod(lerobot_cell)

    def __init__(self, settings: LerobotSettings, say: Say = tell) -> None:
        given = {"left": settings.left, "right": settings.right}
        hands = {hand: its for hand, its in given.items() if its is not None}
        if not hands:
            raise ConfigError(f"{_WHERE}: no hand; allowed: a hand, as right: {{teleoperator: {{type: gamepad}}}}")
        _check_different(hands)
        has_pedal = settings.pedal is not None
        readers: dict[str, DeviceReader[Any]] = {
            hand: DeviceReader(f"{_WHERE}.{hand}", Teleoperator(its, has_pedal), say) for hand, its in hands.items()
        }
        if settings.pedal is not None:
            readers["pedal"] = DeviceReader(f"{_WHERE}.pedal", Pedal(settings.pedal), say)
        super().__init__(readers)
        self._hands = {hand: RateHand(hand) if its.leader is None else LeaderHand(hand) for hand, its in hands.items()}
        self._held: bool | None = False  # Whether the pedal is held; None after it was lost.

    @classmethod
    def from_config(cls, config: Config, say: Say = tell) -> LerobotInput:
        """Make an input with the cell's ``input_settings.lerobot``.

        Raises:
            ConfigError: If a setting is missing or not allowed.
        """
        return cls(LerobotSettings(**config.input_settings.get("lerobot", {})), say)

    def poll(self, now: float) -> list[HandSample]:
        samples = self.samples_of(self._hands, now)
        if "pedal" not in self._readers:
            return samples
        for held in self._readers["pedal"].take():
            self._held = held
        grip = float(self._held or False)
        return [replace(sample, inputs=replace(sample.inputs, press_middle=grip)) for sample in samples]
