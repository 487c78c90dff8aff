"""Write the types of the page's messages in TypeScript, with which the page's scripts are checked.

The types are made from the Python classes of the messages.

python -m tests.web.page_types FILE
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from q2r2_control.inputs.webxr.page_messages import PageMessage
from q2r2_control.inputs.webxr.shown import FromRun

_PLAIN = {"string": "string", "number": "number", "integer": "number", "boolean": "boolean", "null": "null"}
# These tuples have no class of their own, so no schema contains their names.
_NAMED = f"type Point = [{', '.join(['number'] * 3)}];\ntype Seven = [{', '.join(['number'] * 7)}];\n"


def types() -> str:
    """Return the declarations of all types that the page's scripts use."""
    found: dict[str, Any] = {}
    for shape in (PageMessage, FromRun):
        schema = TypeAdapter(shape).json_schema(mode="validation")
        found |= schema.pop("$defs", {}) | {shape.__name__: schema}
    return _NAMED + "".join(f"type {name} = {_type_of(schema)};\n" for name, schema in sorted(found.items()))


def _type_of(schema: dict[str, Any]) -> str:
    """Return the TypeScript type of a JSON schema. Raises KeyError for a type that no message needs yet."""
    if "$ref" in schema:
        return str(schema["$ref"]).rpartition("/")[2]
    if "anyOf" in schema:
        return " | ".join(_type_of(one) for one in schema["anyOf"])
    if "enum" in schema:
        return " | ".join(map(json.dumps, schema["enum"]))
    match schema["type"]:
        case "array" if "prefixItems" in schema:
            return f"[{', '.join(_type_of(one) for one in schema['prefixItems'])}]"
        case "array":
            return f"({_type_of(schema['items'])})[]"
        case "object" if "properties" in schema:
            required = schema.get("required", ())
            fields = schema["properties"].items()
            optional = {name: "" if name in required else "?" for name, _ in fields}
            return f"{{ {'; '.join(f'{name}{optional[name]}: {_type_of(one)}' for name, one in fields)} }}"
        case "object":
            return f"Record<string, {_type_of(schema['additionalProperties'])}>"
        case plain:
            return _PLAIN[plain]


def main() -> None:
    """Write the types to the file that the command line names."""
    file = Path(sys.argv[1])
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(types(), encoding="utf-8")


if __name__ == "__main__":
    main()
