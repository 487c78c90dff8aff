"""The base class of all settings, and the error messages about settings that are not allowed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from difflib import get_close_matches
from ipaddress import IPv4Network, IPv6Network, ip_network
from typing import Any, Self, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Tag, ValidationError
from pydantic_core import ErrorDetails

from q2r2_control.errors import ConfigError, shown

Model = TypeVar("Model", bound=BaseModel)


# For each type of fault of pydantic, a text that says what is allowed. A name in braces is replaced by the value that
# pydantic gives for it.
_ALLOWED = {
    "list_type": "a list such as [a, b]",
    "tuple_type": "a list such as [a, b]",
    "dict_type": "keys with values",
    "model_type": "keys with values",
    "model_attributes_type": "keys with values",
    "string_type": "text",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "{ge:g} or more",
    "less_than": "less than {lt:g}",
    "less_than_equal": "{le:g} or less",
    "too_short": "{min_length} or more entries",
    "too_long": "{max_length} or fewer entries",
    "string_too_short": "{min_length} or more characters",
    "string_too_long": "{max_length} or fewer characters",
    "enum": "{expected}",
    "literal_error": "{expected}",
}


class StrictModel(BaseModel):
    """Settings that allow no unknown keys, no changes, and only finite numbers.

    Raises:
        ConfigError: For wrong values and for a change. The message names key, value and what is allowed.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise config_error(error, type(self)).at(f"{type(self).__name__}: ") from error

    @classmethod
    def model_validate(cls, obj: Any, **options: Any) -> Self:
        return validated(cls, f"{cls.__name__}: ", obj, **options)

    @classmethod
    def model_validate_json(cls, json_data: str | bytes | bytearray, **options: Any) -> Self:
        return validated(cls, f"{cls.__name__}: ", json_data, as_json=True, **options)

    # This attribute tells pydantic that this initialiser is not a custom one. Otherwise, pydantic would call this
    # initialiser for nested settings too, and an error that is raised there could not name the full key.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    def __setattr__(self, name: str, value: object) -> None:
        kind = type(self).__name__
        raise ConfigError(f"{kind}.{name} = {shown(value)}: settings do not change; allowed: another {kind}")


def validated(model: type[Model], where: str, values: object, *, as_json: bool = False, **options: Any) -> Model:
    """Return settings made of ``values``, or of a JSON text. ``options`` are for pydantic's ``model_validate``.

    Raises:
        ConfigError: If a value is not allowed. The message begins with ``where``.
    """
    validator: Any = model.__pydantic_validator__
    try:
        made: Model = (validator.validate_json if as_json else validator.validate_python)(values, **options)
    except ValidationError as error:
        raise config_error(error, model).at(where) from error
    return made


def config_error(
    error: ValidationError, model: type[BaseModel], place: Callable[[Sequence[int | str]], str] = lambda location: ""
) -> ConfigError:
    """Return an error with all faults in a ``model``. Its message has the first fault and the number of others.

    Each line begins with what ``place`` returns for the fault's key. ``place`` takes the parts of the key, the
    outermost part first.
    """
    # If a key is misspelt, the right key is missing too. The misspelt key comes first, because it explains the fault.
    found = sorted(error.errors(), key=lambda fault: fault["type"] != "extra_forbidden")
    # A value that fits none of several types has one fault for each type. Only the first of these faults is kept.
    lines = {_key(fault): place(fault["loc"]) + _line(fault, model) for fault in reversed(found)}
    faults = list(lines.values())[::-1]
    more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
    return ConfigError(faults[0] + more, faults)


def _key(fault: ErrorDetails) -> str:
    # Parts in brackets are not keys. They are pydantic's "[key]", or the tag of one of several models for a value.
    key = ".".join(str(part) for part in fault["loc"] if not str(part).startswith("["))
    return " ".join(key.split())[:300] or "(top level)"


def _line(fault: ErrorDetails, model: type[BaseModel]) -> str:
    """Return one line about a ``fault`` in a ``model``: key, value, and what is allowed."""
    key = _key(fault)
    if fault["type"] == "missing":
        has = "allowed: a list with one more entry" if isinstance(fault["loc"][-1], int) else "and has no default"
        return f"{key}: missing, {has}"
    allowed = allowed_instead(fault)
    if fault["type"] in _ALLOWED and _takes_null(fault["loc"], model):
        allowed += ", or null"
    if fault["type"] == "extra_forbidden":
        keys = _keys_at(fault["loc"][:-1], model)
        meant = get_close_matches(str(fault["loc"][-1]), keys, n=1)
        allowed = f"unknown key; {f'did you mean {meant[0]}? ' if meant else ''}allowed here: {', '.join(keys)}"
    # A block is not shown as a value, because the text already names its unknown key, or the keys that do not fit.
    is_block = fault["type"] in ("value_error", "extra_forbidden") and isinstance(fault["input"], dict)
    value = "" if is_block else f" = {shown(fault['input'])}"
    return f"{key}{value}: {allowed}"


def allowed_instead(fault: ErrorDetails) -> str:
    """Return what is allowed instead of a value: the text of ``_ALLOWED``, or pydantic's text if there is none."""
    words = _ALLOWED.get(fault["type"])
    text = fault["msg"].removeprefix("Value error, ")
    return text if words is None else f"allowed: {words.format(**fault.get('ctx', {}))}"


def _takes_null(location: tuple[int | str, ...], root: type[BaseModel]) -> bool:
    """Return True if the key at ``location`` in ``root`` may also be null."""
    *block, key = location or ("",)  # The location is empty if the whole model is of the wrong type.
    field = getattr(_model_at(tuple(block), root), "model_fields", {}).get(key)
    return field is not None and type(None) in get_args(field.annotation)


def _keys_at(location: tuple[int | str, ...], root: type[BaseModel]) -> list[str]:
    """Return the names of the keys that the model at ``location`` in ``root`` accepts."""
    return sorted(getattr(_model_at(location, root), "model_fields", {}))


def _model_at(location: tuple[int | str, ...], root: type[BaseModel]) -> Any:
    """Return the model of the block at ``location`` in ``root``, or another type if there is no model."""
    model: Any = root
    for part in location:
        annotation = model.model_fields[part].annotation if part in getattr(model, "model_fields", {}) else None
        if annotation is None:
            choices = get_args(next(iter(get_args(model)), None))
            model = next((get_args(choice)[0] for choice in choices if Tag(str(part)) in get_args(choice)), model)
            continue
        arguments = [given for given in getattr(annotation, "__args__", ()) if given is not type(None)]
        model = arguments[-1] if arguments else annotation
    return model


Network = IPv4Network | IPv6Network


def network_of(text: str) -> Network:
    """Return the network ``text``, such as ``192.168.1.0/24`` or ``fd00::/64``. An address is a network of one host.

    Raises:
        ValueError: If the text is not a network. The message names the text and what is allowed.
    """
    try:
        return ip_network(text)
    except ValueError:
        pass
    try:
        meant = ip_network(text, strict=False)
    except ValueError:
        raise ValueError(f"{text!r:.60} is neither an address nor a network such as 192.168.1.0/24") from None
    raise ValueError(f"{text!r} is an address within a network: write {meant}, or {text.split('/')[0]} alone")


# The time-out is eleven periods of a 75 Hz headset, so that a few lost or late messages on a wireless link do not stop
# the arms. In this time, a tool at the default 0.5 m/s moves no more than 75 mm before it begins to brake. The time-out
# holds for hand data, tool poses, targets and acknowledgements of commands.
STREAM_TIMEOUT = 0.15  # [s]
