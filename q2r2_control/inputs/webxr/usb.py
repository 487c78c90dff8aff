"""Connect a headset by USB: adb forwards a port of the headset to this machine. HTTPS and Wi-Fi are not needed."""

from __future__ import annotations

import subprocess

from q2r2_control.errors import InputError

_PATIENCE = 15.0  # Longest time for adb, which may start a server of its own [s].


def reverse(port: int, *, remove: bool = False) -> None:
    """Forward the headset's ``port`` to the same port of this machine, or end this forwarding.

    Raises:
        InputError: If adb fails.
    """
    command = ["adb", "reverse", *(["--remove", f"tcp:{port}"] if remove else [f"tcp:{port}"] * 2)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE, check=False)
    except FileNotFoundError as error:
        raise InputError("--usb needs adb, which is not installed: apt install adb") from error
    except (OSError, subprocess.TimeoutExpired) as error:
        raise InputError(f"--usb: {' '.join(command)}: {error}") from error
    if done.returncode:
        reason = " ".join((done.stderr or done.stdout).split()) or f"exit code {done.returncode}"
        raise InputError(
            f"--usb: {' '.join(command)}: {reason}; allowed: one headset in developer mode on the cable, which has "
            "been allowed to be debugged from this computer"
        )
