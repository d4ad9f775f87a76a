"""Holds a JSON output against the schema file that is shipped for it."""

from __future__ import annotations

import json
from typing import Any

from zsched.commands.base.common import SCHEMAS


def closed(schema: Any) -> Any:
    """The schema with every object closed: a field that it does not name is a fault."""
    if isinstance(schema, list):
        return [closed(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    found = {key: closed(value) for key, value in schema.items()}
    if "properties" in found and isinstance(schema.get("required"), list):
        found["additionalProperties"] = False
    return found


def faults(body: Any) -> list[str]:
    """What is wrong with an output by the file of the schema that it names."""
    import jsonschema  # it reads grammars for seconds, in each process that imports it

    name, _, major = body["schema"].partition("/")
    schema = json.loads((SCHEMAS / f"{name}.{major}.json").read_text())
    validator = jsonschema.Draft202012Validator(closed(schema))
    return [f"{error.json_path}: {error.message}" for error in validator.iter_errors(body)]
