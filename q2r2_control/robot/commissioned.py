"""The sign-off of a cell's commissioning, a file beside the cell, and whether it is still of that cell."""

from __future__ import annotations

import hashlib
import json
from ipaddress import ip_address
from pathlib import Path

from q2r2_control.config.cell import Config
from q2r2_control.config.control import LIVE
from q2r2_control.robot.compose import compose

FIRST_SPEED = 0.1  # until the operator says otherwise, of what the cell allows


def sign_off_file(cell: Path) -> Path:
    """Where the sign-off of the ``cell``'s file is kept."""
    return cell.with_suffix(".commissioned.json")


def fingerprint(config: Config) -> str:
    """Of all that a commissioning has looked at: addresses, mounts, tools, limits; not of obstacles and gains."""
    arms = compose(config.model_copy(update={"obstacles": {}, "floor": None})).urdf
    control = config.control.model_dump(mode="json", exclude=set(LIVE) - {"min_distance"})
    fri = {arm: cabinet.model_dump(mode="json") for arm, cabinet in config.fri.items()}
    text = json.dumps([arms, control, fri], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def has_real_cabinets(config: Config) -> bool:
    """Whether a cabinet is not on this computer, where it stands in for a real one."""
    return not all(ip_address(cabinet.address).is_loopback for cabinet in config.fri.values())


def slowed(config: Config) -> Config:
    """The same cell at a tenth of its joints' speed."""
    scale = FIRST_SPEED * config.control.velocity_scale
    return config.model_copy(update={"control": config.control.model_copy(update={"velocity_scale": scale})})


def not_commissioned(config: Config, cell: Path) -> str | None:
    """Why the real arms of ``config``, read from the file ``cell``, may not be driven yet; None: they may."""
    if not has_real_cabinets(config):
        return None
    file = sign_off_file(cell)
    try:
        kept = json.loads(file.read_text(encoding="utf-8"))
        its, date = str(kept["fingerprint"]), str(kept["date"])
    except FileNotFoundError:
        return f"there is no {file.name}"
    except (OSError, ValueError, TypeError, KeyError) as error:
        return f"{file.name} cannot be read: {error!s:.80}"
    return None if its == fingerprint(config) else f"addresses, mounts, tools or limits were changed since {date}"
