"""SpaceMice of 3Dconnexion as hands: the cap gives a hand's velocity, and two buttons are the hand's buttons.

The Python library hidapi reads the devices. One project maintains it and the C library that it calls. Its wheels
contain the C library for Linux, macOS and Windows. It names each device by path and serial number. The library
pyspacemouse is not used: it needs a binding from 2017 that does not contain the C library, and it does not tell which
readings are new. evdev is not used, because it exists only on Linux. Also, its kernel driver leaves out readings that
did not change. Therefore a device that is switched off looks the same as a device that is held still.
"""

from __future__ import annotations

import os
import struct
import sys
from collections.abc import Iterable
from typing import Any

import numpy as np
from pydantic import Field

from q2r2_control import (
    Config,
    ConfigError,
    DeviceControls,
    DeviceWords,
    HandInputs,
    HandSample,
    InputError,
    StrictModel,
)
from q2r2_devices.rate import RateHand, RateReading
from q2r2_devices.reading import READ_TIMEOUT, DeviceInput, DeviceReader, Say, tell

# HID Usage Tables 1.5, section 4: page and usage of a multi-axis controller.
_MULTI_AXIS = 0x01, 0x08
_FULL = 350.0  # Reading of an axis at full deflection, as the device list of pyspacemouse 2.1 has it for all models.
_WORDS = DeviceWords(
    nouns={"lower": "the left button", "upper": "the right button"},
    absent="nothing: a SpaceMouse is not connected",
)


class MouseSettings(StrictModel):
    """The settings of one hand's SpaceMouse."""

    device: str | None = Field(
        None, description="path, link to a path, or serial number; null: the only SpaceMouse of this computer"
    )
    speed: float = Field(0.2, gt=0, le=1, description="speed of the hand at full deflection [m/s]")
    angular_speed: float = Field(0.8, gt=0, le=3, description="the same for the rotation [rad/s]")
    dead_zone: float = Field(
        0.05, ge=0, le=0.5, description="fraction of the deflection below which an axis counts as at rest"
    )


class SpaceMouseSettings(StrictModel):
    """The settings of ``input_settings.spacemouse``. A hand that is null has no SpaceMouse."""

    left: MouseSettings | None = None
    right: MouseSettings | None = None


class Reports:
    """The state of a SpaceMouse after its HID reports. Numbers are little-endian and 16 bits wide.

    Report 1 has x, y, z. Report 2 has Rx, Ry, Rz. Newer models send all six in report 1. Report 3 has one bit for each
    button. The layout is in the device list of pyspacemouse 2.1. The axes are those of the HID Usage Tables 1.5,
    section 4.2: x to the right, y towards the user, z down, and rotations by the right-hand rule.
    """

    def __init__(self, settings: MouseSettings) -> None:
        self._settings = settings
        self._axes = np.zeros(6)
        self._buttons = 0

    def take(self, report: bytes) -> RateReading | None:
        """Return the reading after a report; None if the report is of another kind, such as the battery's."""
        kind, size = (report[0], len(report) - 1) if report else (0, 0)
        if kind == 1 and size >= 12:
            self._axes[:] = struct.unpack_from("<6h", report, 1)
        elif kind in (1, 2) and size >= 6:
            self._axes[3 * kind - 3 : 3 * kind] = struct.unpack_from("<3h", report, 1)
        elif kind == 3 and size >= 1:
            self._buttons = report[1]
        else:
            return None
        inputs = HandInputs(button_lower=bool(self._buttons & 1), button_upper=bool(self._buttons & 2))
        return RateReading(self._velocity(), inputs)

    def _velocity(self) -> np.ndarray:
        its = self._settings
        deflection = np.clip(self._axes / _FULL, -1.0, 1.0)
        beyond = np.maximum(np.abs(deflection) - its.dead_zone, 0.0) / (1.0 - its.dead_zone)
        right, back, down, about_right, about_back, about_down = np.copysign(beyond, deflection)
        linear = its.speed * np.array([-back, -right, -down])
        return np.concatenate([linear, its.angular_speed * np.array([-about_back, -about_right, -about_down])])


class SpaceMouse:
    """A SpaceMouse, as a :class:`~q2r2_devices.reading.Device`.

    Args:
        settings: The settings of the hand.
        users: The SpaceMouse that uses each path. All hands share it, because one device must not move two arms.
    """

    def __init__(self, settings: MouseSettings, users: dict[str, SpaceMouse]) -> None:
        self._settings, self._users = settings, users
        self._device: Any = None

    def open(self) -> str:
        hid = _hidapi()
        found = {info["path"]: info for info in hid.enumerate() if (info["usage_page"], info["usage"]) == _MULTI_AXIS}
        wanted = self._settings.device
        fit = [info for info in found.values() if wanted is None or wanted in _names(info)]
        fit = fit or [info for info in found.values() if os.path.realpath(str(wanted)) in _names(info)]
        if len(fit) != 1:
            problem = "several devices fit" if fit else "is not there" if wanted else "no SpaceMouse is there"
            raise InputError(f"device = {wanted or 'null'}: {problem}; connected now: {_listed(found.values())}")
        path = fit[0]["path"].decode()
        if os.path.exists(path) and not os.access(path, os.R_OK | os.W_OK):
            rule = f'KERNEL=="hidraw*", ATTRS{{idVendor}}=="{fit[0]["vendor_id"]:04x}", TAG+="uaccess"'
            cure = f"as root, write {rule} to /etc/udev/rules.d/70-spacemouse.rules, and plug the SpaceMouse in again"
            raise InputError(f"no permission to read {path}; {cure}")
        if self._users.setdefault(path, self) is not self:
            raise InputError(
                f"device = {wanted or 'null'}: {path} moves the other hand; allowed: the path or serial number of "
                f"another SpaceMouse; connected now: {_listed(found.values())}"
            )
        self._device = hid.device()
        self._device.open_path(fit[0]["path"])
        self._reports = Reports(self._settings)
        return f"{fit[0]['product_string']} at {path}"

    def read(self) -> RateReading | None:
        return self._reports.take(bytes(self._device.read(64, round(1000 * READ_TIMEOUT))))

    def close(self) -> None:
        for path in [path for path, user in self._users.items() if user is self]:
            del self._users[path]
        if self._device is not None:
            self._device.close()


def _listed(found: Iterable[dict[str, Any]]) -> str:
    return ", ".join(" or ".join(_names(info)) for info in found) or "none"


def _names(info: dict[str, Any]) -> list[str]:
    return [name for name in (info["path"].decode(), info["serial_number"]) if name]


def _hidapi() -> Any:
    """Return hidapi's module. On Linux, this is its variant for hidraw, which does not detach the kernel's driver.

    Therefore the desktop can still use the device.

    Raises:
        InputError: If hidapi is not installed.
    """
    try:
        if sys.platform == "linux":
            import hidraw as hid
        else:
            import hid
    except ImportError as error:
        raise InputError("hidapi is not installed; allowed: pip install 'hidapi>=0.14,<0.16'") from error
    return hid


class SpaceMouseInput(DeviceInput):
    """One or two SpaceMice as hands. Implements :class:`~q2r2_control.Input`."""

    settings = SpaceMouseSettings
    controls = DeviceControls(buttons=("button_lower", "button_upper"), axes=(), words=_WORDS)

    def __init__(self, settings: SpaceMouseSettings, say: Say = tell) -> None:
        mice = {"left": settings.left, "right": settings.right}
        given = {hand: its for hand, its in mice.items() if its is not None}
        if not given:
            raise ConfigError("input_settings.spacemouse: no hand; allowed: a hand, as right: {}")
        where = "input_settings.spacemouse"
        users: dict[str, SpaceMouse] = {}
        mice_of_hands = {hand: SpaceMouse(its, users) for hand, its in given.items()}
        super().__init__({hand: DeviceReader(f"{where}.{hand}", its, say) for hand, its in mice_of_hands.items()})
        self._hands = {hand: RateHand(hand) for hand in given}

    @classmethod
    def from_config(cls, config: Config, say: Say = tell) -> SpaceMouseInput:
        """Make an input with the cell's ``input_settings.spacemouse``.

        Raises:
            ConfigError: If a setting is missing or not allowed.
        """
        return cls(SpaceMouseSettings(**config.input_settings.get("spacemouse", {})), say)

    def poll(self, now: float) -> list[HandSample]:
        return self.samples_of(self._hands, now)
