"""The model arguments of ``q2r2 new-cell``: arguments of xacro, and MJCF files, which are converted to URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from q2r2_control.cli.answers import RememberedAnswers
from q2r2_control.config.resources import find_resource
from q2r2_control.errors import ConfigError
from q2r2_control.robot.description import MJCF_ENDS

SPEEDS = 0.01, 10.0  # Allowed range of a joint's speed limit [rad/s].


def named_values(given: list[str]) -> dict[str, str]:
    """Split texts NAME=VALUE, and return the values by name.

    Raises :class:`ConfigError` if a text has another form.
    """
    for text in given:
        if not text.partition("=")[0].strip() or "=" not in text:
            raise ConfigError(f"--xacro-arg {text!r:.80}: allowed: NAME=VALUE")
    return {name: value for name, _, value in (text.partition("=") for text in given)}


def without_mjcf(
    models: dict[str, str], name: str, velocity: float | None, yes: bool, answers: RememberedAnswers
) -> dict[str, str]:
    """Convert each MJCF file among the models to a URDF file, and return the models with these URDF files.

    Args:
        models: The models, by side or "robot".
        name: The name of the cell, with which the names of the URDF files begin.
        velocity: The speed limit of all joints [rad/s], which MJCF does not have; None to ask for it.
        yes: True if no question may be asked.
        answers: Asks the question.

    Raises:
        Q2R2Error: If a file cannot be converted, or if an argument is missing or wrong.
    """
    sides = {model: side for side, model in reversed(models.items()) if model.endswith(MJCF_ENDS)}
    files = {model: Path(f"{name}_{side}.urdf") for model, side in sides.items()}
    for model, file in files.items():
        if file.exists():
            raise ConfigError(f"{file}: exists; give it as --{sides[model]}, without --velocity, or another NAME")
    if not files:
        if velocity is not None:
            raise ConfigError(f"--velocity: allowed with a model that ends in {' or '.join(MJCF_ENDS)}")
        return models
    if velocity is None and yes:
        raise ConfigError("--velocity: an MJCF has no limits of speed; allowed: what each joint bears [rad/s]")
    if velocity is None:
        question = "limit of the joints' speed, which an MJCF does not have, in rad/s"
        velocity = answers.ask(question, 1.0)
        if not SPEEDS[0] <= velocity <= SPEEDS[1]:
            raise ConfigError(f"{question} = {velocity:g}: allowed: {SPEEDS[0]:g} .. {SPEEDS[1]:g}")
    from q2r2_control.robot.mjcf import urdf_of_mjcf  # The import is here, because only MJCF needs MuJoCo.

    urdfs = {model: urdf_of_mjcf(find_resource(model), file.parent, velocity) for model, file in files.items()}
    for model, urdf in urdfs.items():
        ET.indent(urdf)
        files[model].write_text(ET.tostring(urdf, encoding="unicode"), encoding="utf-8")
    return {side: str(files.get(model, model)) for side, model in models.items()}
