"""The sign-off of a cell's commissioning, a file beside the cell, and whether it is still of that cell."""

from __future__ import annotations

import hashlib
import json
from ipaddress import ip_address
from pathlib import Path

from q2r2_control.config.cell import Config
from q2r2_control.config.control import LIVE
from q2r2_control.robot.compose import compose


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


def not_commissioned(config: Config, cell: Path) -> str | None:
    """Why the arms of ``config``, read from the file ``cell``, may not be driven yet; None: they may.

    Cabinets on this computer stand in for real ones, and need no commissioning.
    """
    if all(ip_address(cabinet.address).is_loopback for cabinet in config.fri.values()):
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
