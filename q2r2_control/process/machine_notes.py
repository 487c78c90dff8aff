"""Find reasons why this computer may answer a robot late, each with the command that helps."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

from q2r2_control.process.scheduling import real_time

_LEAST_MTU = 1500  # Least MTU for which every message of a cabinet is one packet [bytes].
_FAIR_SERVER = "/sys/kernel/debug/sched/fair_server"
_GATHERS = re.compile(r"^(Adaptive RX: on|rx-usecs: *[1-9]\d*)", re.MULTILINE)
_RING = re.compile(r"^RX:\s*(\d+)", re.MULTILINE)


def has_display(environment: Mapping[str, str] = os.environ) -> bool:
    """Return whether this computer has a display for a window."""
    return sys.platform != "linux" or bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


def machine_notes() -> list[str]:
    """Return notes about the kernel, its scheduler and the processors."""
    notes = []
    with real_time() as refused:
        if refused:
            notes.append(refused)
    if sys.platform == "linux" and _text("/sys/kernel/realtime") != "1":
        notes.append("the kernel has no PREEMPT_RT: answers may be late by milliseconds; install a real-time kernel")
    if _text("/proc/sys/kernel/sched_rt_runtime_us") not in ("", "-1"):
        notes.append(
            "Linux halts real-time threads for 50 ms once they took 95 % of a processor for a second;"
            " sysctl -w kernel.sched_rt_runtime_us=-1"
        )
    notes += fair_server_notes(os.uname().release, Path(_FAIR_SERVER)) if sys.platform == "linux" else []
    governor = _text("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    if governor not in ("", "performance"):
        notes.append(f"the processors' governor is {governor}; cpupower frequency-set -g performance")
    return notes


def fair_server_notes(release: str, folder: Path) -> list[str]:
    """Return notes about the processor time that Linux 6.12 and later keep for other programs.

    The kernel halts real-time threads to keep this time.

    Args:
        release: Release of the kernel.
        folder: The kernel's folder with the kept time of each processor. Only root may read it.
    """
    major, minor, *_ = *map(int, re.findall(r"\d+", release)[:2]), 0, 0
    shares = [_text(file) for file in folder.glob("cpu*/runtime")]
    if (major, minor) < (6, 12) or (shares and set(shares) == {"0"}):
        return []
    return [
        "Linux halts real-time threads for up to 50 ms where other programs got less than 5 % of a processor in a"
        f" second; leave a processor free, or, as root and without Secure Boot: echo 0 | tee {folder}/cpu*/runtime"
    ]


def network_notes(addresses: Iterable[str]) -> list[str]:
    """Return notes about the network cards that lead to ``addresses``. This computer's own addresses need no card."""
    if sys.platform != "linux":
        return []
    routes = (_output("ip", "-j", "route", "get", address) for address in sorted(set(addresses)))
    cards = {json.loads(route)[0]["dev"] for route in routes if route}
    notes = [note for card in sorted(cards) for note in card_notes(card)]
    if any(Path(f"/sys/class/net/{card}/device").exists() for card in cards) and not _output("ethtool", "--version"):
        notes.append("how the network card gathers interrupts is not known: install ethtool")
    return notes


def card_notes(card: str) -> list[str]:
    """Return notes about one network card, from ``ethtool``."""
    notes = []
    mtu = _text(f"/sys/class/net/{card}/mtu")
    if mtu and int(mtu) < _LEAST_MTU:
        notes.append(f"{card}: MTU {mtu}, so messages may come in pieces; ip link set {card} mtu {_LEAST_MTU}")
    if found := _GATHERS.search(_output("ethtool", "-c", card)):
        notes.append(f"{card} gathers messages ({found[0].lower()}); ethtool -C {card} adaptive-rx off rx-usecs 0")
    ring = [int(size) for size in _RING.findall(_output("ethtool", "-g", card))]  # The greatest and the present size.
    if len(ring) == 2 and ring[1] < ring[0]:
        notes.append(f"{card}: a ring buffer of {ring[1]} messages; ethtool -G {card} rx {ring[0]}")
    return notes


def _text(file: str | Path) -> str:
    """Return the text of a file; "" if it does not exist or may not be read."""
    try:
        return Path(file).read_text().strip()
    except OSError:
        return ""


def _output(*words: str) -> str:
    """Return the output of a command; "" if it does not exist or fails."""
    try:
        return subprocess.run(words, capture_output=True, text=True, check=True, timeout=5).stdout
    except (OSError, subprocess.SubprocessError):
        return ""
