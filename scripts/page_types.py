"""Types of the server's live messages and answers for `tsc --checkJs`, as TypeScript."""

from __future__ import annotations

import json
from typing import Any

from pydantic import TypeAdapter

from service.protocol.live import PageMessage

_PLAIN = {"integer": "number"} | {name: name for name in ("number", "string", "boolean", "null")}


def render_types(openapi: dict[str, Any]) -> str:
    """Return the types of all messages to pages, and of all bodies of the API, by name.

    Raises:
        ValueError: a schema has an unknown shape, or one name has two shapes.
    """
    live = TypeAdapter(PageMessage).json_schema(mode="serialization")
    types: dict[str, str] = {}
    for schemas in (openapi["components"]["schemas"], live.pop("$defs"), {"PageMessage": live}):
        for name, schema in schemas.items():
            text = _render_type(schema)
            if types.setdefault(name, text) != text:
                raise ValueError(f"{name} has two shapes:\n{types[name]}\n{text}")
    texts = [f"type {name} = {types[name]};\n" for name in sorted(types)]
    return "\n".join(["// Written by tests/test_docs.py.\n", *texts])


def _render_type(schema: dict[str, Any]) -> str:
    match schema:
        case {"$ref": address}:
            return str(address).rsplit("/", 1)[1]
        case {"const": value}:
            return json.dumps(value)
        case {"enum": values}:
            return " | ".join(map(json.dumps, values))
        case {"anyOf": choices} | {"oneOf": choices}:
            return " | ".join(dict.fromkeys(map(_render_type, choices)))
        case {"prefixItems": items}:
            return f"[{', '.join(map(_render_type, items))}]"
        case {"items": item}:
            return f"Array<{_render_type(item)}>"
        case {"properties": fields}:
            optional = fields.keys() - schema.get("required", ())
            lines = [
                f"  {name}{'?' * (name in optional)}: {_render_type(field)};\n"
                for name, field in fields.items()
            ]
            return f"{{\n{''.join(lines)}}}"
        case {"additionalProperties": dict() as item}:
            return f"Record<string, {_render_type(item)}>"
        case {"additionalProperties": True}:
            return "Record<string, any>"
        case {"type": str(plain)} if plain in _PLAIN:
            return _PLAIN[plain]
    raise ValueError(f"a schema of unknown shape: {schema}")
