"""The sign-off of a cell's commissioning: a file beside the cell's file. It is valid while the cell does not change."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from ipaddress import ip_address
from pathlib import Path

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.control import LIVE
from q2r2_control.config.resources import find_resource
from q2r2_control.errors import ConfigError
from q2r2_control.plugins import PLANTS, load_class
from q2r2_control.robot.compose import compose

FIRST_SPEED = 0.1  # Share of the cell's speed at which real arms move, unless the user asks for full speed.


def sign_off_file(cell: Path) -> Path:
    """Return the path of the sign-off for the file ``cell``."""
    return cell.with_suffix(".commissioned.json")


def fingerprint(config: Config) -> str:
    """Return a hash of everything that a commissioning checks: addresses, mounts, tools and limits."""
    arms = compose(config.model_copy(update={"obstacles": {}, "floor": None})).urdf
    control = config.control.model_dump(mode="json", exclude=set(LIVE) - {"min_distance"})
    fri = {arm: cabinet.model_dump(mode="json") for arm, cabinet in config.fri.items()}
    text = json.dumps([arms, control, fri], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def has_real_cabinets(config: Config) -> bool:
    """Return whether at least one cabinet is not on this computer. Simulated cabinets run on this computer."""
    return not all(ip_address(cabinet.address).is_loopback for cabinet in config.fri.values())


def drives_real_arms(config: Config, plant: str) -> bool:
    """Return whether the plant with the name ``plant`` moves real arms in this cell.

    Raises:
        ConfigError: If no installed plant has this name, or if the plant cannot be imported.
    """
    its_answer: Callable[[Config], bool] | None = getattr(load_class(PLANTS, plant), "drives_real_arms", None)
    return its_answer is not None and its_answer(config)


def slowed(config: Config) -> Config:
    """Return the same cell with a tenth of the joints' speeds."""
    scale = FIRST_SPEED * config.control.velocity_scale
    return config.model_copy(update={"control": config.control.model_copy(update={"velocity_scale": scale})})


def not_commissioned(config: Config, cell: Path) -> str | None:
    """Return why the real arms of ``config``, from the file ``cell``, may not be driven yet; None if they may."""
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


def load_commissioned(path: str | os.PathLike[str], plant: str | None = None, *, full_speed: bool = False) -> Config:
    """Read a cell whose real arms may be driven, by the rules of ``q2r2 run``.

    A cell that drives no real arms is returned as :func:`load_config` returns it.

    Args:
        path: The cell's YAML, in a form that :func:`load_config` takes.
        plant: The name of the plant that will move the arms; None for the plant that the cell names.
        full_speed: True to let real arms move as fast as the cell says. Otherwise they move at a tenth of this speed.

    Raises:
        ConfigError: If the file cannot be used, or if its real cabinets were not commissioned in their present state.
    """
    config = load_config(path)
    plant = plant or config.plant
    if plant == "fri" and (why := not_commissioned(config, find_resource(path))):
        raise ConfigError(f"{path}: {why}; q2r2 commission {path} commissions it")
    return slowed(config) if drives_real_arms(config, plant) and not full_speed else config
