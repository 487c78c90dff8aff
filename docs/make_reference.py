"""Write docs/configuration.md, the reference of a cell's YAML, from the descriptions and bounds of the settings."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from q2r2_control.config.cell import Config

FILE = Path(__file__).with_name("configuration.md")
_HEAD = """\
# Configuration

This page lists every key of a cell's YAML, with its default and the allowed values. A key without a default is
required. `q2r2 check CELL.yaml` checks a file. For each fault, it names the key, the value and what is allowed.
[`config/dual_iiwa7.yaml`](../config/dual_iiwa7.yaml) contains every key. This page is written by
`python docs/make_reference.py`.
"""
_BOUNDS = (("minimum", ">="), ("exclusiveMinimum", ">"), ("maximum", "<="), ("exclusiveMaximum", "<"))


def reference() -> str:
    """Return the text of the page."""
    schema = Config.model_json_schema()
    return _HEAD + "".join(_sections("", schema, schema["$defs"]))


def _sections(key: str, model: dict[str, Any], models: dict[str, Any]) -> Iterator[str]:
    """Yield a section for the ``model`` of settings at ``key``, and then one for each model below it."""
    about = " ".join(model.get("description", "").split("\n\n")[0].split()) if key else "The whole file."
    rows = [_row(name, field, name in model.get("required", ()), models) for name, field in model["properties"].items()]
    yield f"\n## {f'`{key}`' if key else 'Top level'}\n\n{about}\n\n"
    yield "| key | default | allowed | meaning |\n|---|---|---|---|\n" + "".join(rows)
    for name, field in model["properties"].items():
        for suffix, below in _models_in(field, models):
            yield from _sections(f"{key}.{name}{suffix}".lstrip("."), below, models)


def _row(name: str, field: dict[str, Any], required: bool, models: dict[str, Any]) -> str:
    below = any(_models_in(field, models))
    default = field.get("default", {} if field.get("type") == "object" else None)
    shown = "" if required or (below and default not in (None, [], {})) else f"`{json.dumps(default)}`"
    cells = f"`{name}`", shown, "see below" if below else _allowed(field, models), field.get("description", "")
    return "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in cells) + " |\n"


def _choices(field: dict[str, Any], models: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the types that a field may have, with all references resolved."""
    found = []
    for choice in field.get("anyOf") or field.get("allOf") or [field]:
        reference = choice.get("$ref")
        if "oneOf" in choice:
            found += _choices({"anyOf": choice["oneOf"]}, models)
        else:
            found.append(models[reference.rpartition("/")[2]] if reference else choice)
    return found


def _models_in(field: dict[str, Any], models: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the models of settings that a field contains, with the text between the field's key and theirs."""
    for choice in _choices(field, models):
        if "properties" in choice:
            yield "", choice
        insides = [(".<name>", value) for value in choice.get("patternProperties", {}).values()]
        insides += [(".<name>", choice.get("additionalProperties")), ("[]", choice.get("items"))]
        for suffix, inside in insides:
            if isinstance(inside, dict):
                yield from ((suffix + more, below) for more, below in _models_in(inside, models))


def _allowed(field: dict[str, Any], models: dict[str, Any]) -> str:
    return " or ".join(dict.fromkeys(_allowed_by(choice, models) for choice in _choices(field, models)))


def _allowed_by(choice: dict[str, Any], models: dict[str, Any]) -> str:
    if "enum" in choice:
        return ", ".join(f"`{value}`" for value in choice["enum"])
    if "const" in choice:
        return f"`{choice['const']}`"
    kind = {"null": "`null`", "boolean": "true, false", "string": "text", "object": "mapping"}.get(
        choice.get("type", "")
    )
    if choice.get("type") == "array":
        parts = choice.get("prefixItems")
        return (
            f"{len(parts)} of: {_allowed(parts[0], models)}"
            if parts
            else f"list of: {_allowed(choice.get('items', {}), models)}"
        )
    if kind is not None:
        return kind
    bounds = [f"{sign} {choice[name]:g}" for name, sign in _BOUNDS if name in choice]
    return ", ".join(bounds) or choice.get("type", "any")


if __name__ == "__main__":
    FILE.write_text(reference(), encoding="utf-8")
    print(FILE)
