"""A settings model as parameters of a node: one for each field, with its description and range."""

from __future__ import annotations

from enum import Enum
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException

from q2r2_control.errors import ConfigError
from q2r2_control.ros.bridge.base_node import BaseNode

Model = TypeVar("Model", bound=BaseModel)
NONE = 0.0  # of a number that may be none; no such field allows zero


def declared(
    node: BaseNode,
    name: str,
    default: Any,
    description: str,
    *,
    at_least: float | None = None,
    at_most: float | None = None,
) -> Any:
    """Declare a parameter and return its value. Raises :class:`ConfigError` for a value of wrong type or range."""
    try:
        return node.parameter(name, default, description, at_least=at_least, at_most=at_most)
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        bounds = "" if at_least is None or at_most is None else f" from {at_least:g} to {at_most:g}"
        raise ConfigError(f"parameter {name}: {error}; allowed is a {type(default).__name__}{bounds}") from error


def settings_from_parameters(node: BaseNode, prefix: str, default: Model, leave_out: frozenset[str]) -> Model:
    """Declare ``prefix.field`` for every field of ``default`` but those left out; returns the settings they make.

    Nested models become nested names; a number that may be none is none where the parameter is 0.
    Raises :class:`ConfigError` that names the parameter.
    """
    try:
        return type(default).model_validate(_values(node, prefix, default, leave_out))
    except ValidationError as error:
        fault = error.errors()[0]
        name = ".".join([prefix, *map(str, fault["loc"])])
        raise ConfigError(
            f"parameter {name} = {fault['input']!r:.60}: {fault['msg'].removeprefix('Value error, ')}"
        ) from error


def _values(node: BaseNode, prefix: str, default: BaseModel, leave_out: frozenset[str]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, field in type(default).model_fields.items():
        value = getattr(default, key)
        if key in leave_out:
            values[key] = value
        elif isinstance(value, BaseModel):
            values[key] = _values(node, f"{prefix}.{key}", value, leave_out)
        else:
            values[key] = _value(node, f"{prefix}.{key}", value, field)
    return values


def _value(node: BaseNode, name: str, default: Any, field: FieldInfo) -> Any:
    description = field.description or name
    may_be_none = type(None) in getattr(field.annotation, "__args__", ())
    if may_be_none:
        given = declared(node, name, NONE if default is None else default, f"{description}; here 0")
        return None if given == NONE else given
    if isinstance(default, Enum):
        return declared(node, name, str(default.value), description)
    if isinstance(default, tuple):
        return tuple(declared(node, name, list(default), description))
    return declared(node, name, default, description, **_range(field))


def _range(field: FieldInfo) -> dict[str, float]:
    """The closed range of a field; open ends are the model's to check."""
    bounds: dict[str, float] = {}
    for entry in field.metadata:
        for attribute, bound in (("ge", "at_least"), ("gt", "at_least"), ("le", "at_most"), ("lt", "at_most")):
            if hasattr(entry, attribute):
                bounds[bound] = float(getattr(entry, attribute))
    return bounds if len(bounds) == 2 else {}
