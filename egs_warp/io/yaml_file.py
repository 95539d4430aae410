"""Reading of YAML files written by users: safe loading without aliases, and validation against a JSON schema, with the
line number of a mistake; and writing of values that are read back unchanged."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar

from egs_warp.errors import UserError, did_you_mean
from egs_warp.io.text import MAX_NESTING, read_text

_TAG = "tag:yaml.org,2002:"
_NUMBERS = {
    "int": re.compile(r"[-+]?(?:0|[1-9][0-9]*)$"),
    "float": re.compile(r"[-+]?(?:[0-9]+(?:\.[0-9]*)?[eE][-+]?[0-9]+|[0-9]+\.[0-9]*|\.[0-9]+(?:[eE][-+]?[0-9]+)?)$"),
}
"""Finite decimal numbers by type, as in YAML 1.2. PyYAML follows YAML 1.1, in which 1e-3 is a string, 045 is 37, and
1:30 is 90."""
_NUMBER_STARTS = "-+.0123456789"
"""Characters with which a number may begin."""
_OTHER_TYPES = ("null", "bool", "merge")
"""Other types of values that are recognised without a tag; all other values are strings."""


def read_yaml(path: Path) -> tuple[Any, Any]:
    """Return the values of a YAML file, and its root node, from which ``line_of`` determines line numbers.

    Raises ``UserError`` if the file cannot be read or is not YAML, or contains an alias or the same key twice.
    """
    import yaml

    class Plain(yaml.SafeLoader):
        """YAML loader that rejects aliases, because a few lines of nested aliases can expand beyond the available
        memory.

        Nesting is limited for the reason given in ``load_json``.
        """

        depth = 0
        # Without the resolvers of PyYAML for numbers and dates.
        yaml_implicit_resolvers: ClassVar = {
            letter: [one for one in found if one[0] in [_TAG + name for name in _OTHER_TYPES]]
            for letter, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
        }

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                where = self.peek_event().start_mark
                raise yaml.MarkedYAMLError(problem="an alias, *name; write out what it stands for", problem_mark=where)
            self.depth += 1
            if self.depth > MAX_NESTING:
                where = self.peek_event().start_mark
                raise yaml.MarkedYAMLError(
                    problem="lists are nested too deeply; write fewer levels", problem_mark=where
                )
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            keys: set[str] = set()
            for key, _ in node.value:
                if str(key.value) in keys:
                    problem = f"the key {str(key.value)[:80]!r} occurs twice; remove one"
                    raise yaml.MarkedYAMLError(problem=problem, problem_mark=key.start_mark)
                keys.add(str(key.value))
            return super().construct_mapping(node, deep)

        def construct_number(self, node: Any) -> int | float:
            text = self.construct_scalar(node)
            value = float(text)
            if not abs(value) < float("inf"):
                problem = f"{text[:80]} is not a finite number"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)
            return int(text) if node.tag == f"{_TAG}int" else value

    for name, pattern in _NUMBERS.items():
        Plain.add_implicit_resolver(_TAG + name, pattern, list(_NUMBER_STARTS))
        Plain.add_constructor(_TAG + name, Plain.construct_number)
    try:
        loader = Plain(read_text(path))
        try:
            node = loader.get_single_node()
            return None if node is None else loader.construct_document(node), node
        finally:
            loader.dispose()
    except (yaml.YAMLError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        mark = getattr(error, "problem_mark", None)
        where = f"{path}, line {mark.line + 1}" if mark is not None else f"{path}"
        reason = getattr(error, "problem", None) or str(error)
        reason += ": indent with spaces, not tabs" if "'\\t'" in reason else ""
        raise UserError(f"{where}: not YAML ({' '.join(reason.split())}); correct it") from error


def yaml_text(values: Mapping[str, Any]) -> str:
    """Return ``values`` as the text of a YAML file, from which ``read_yaml`` reads equal values: strings that would be
    read as numbers are quoted."""
    import yaml

    class Quoting(yaml.SafeDumper):
        """YAML writer that also quotes strings such as 1e5, which are not numbers for PyYAML."""

    for name, pattern in _NUMBERS.items():
        Quoting.add_implicit_resolver(_TAG + name, pattern, list(_NUMBER_STARTS))
    return yaml.dump(dict(values), Dumper=Quoting, sort_keys=False, allow_unicode=True)


def check_schema(path: Path, values: Any, node: Any, schema: str) -> None:
    """Validate the ``values`` of a YAML file against a schema in the package ``egs_warp.io``.

    Raises ``UserError`` for the first mistake, with its line and entry.
    """
    errors = sorted(_validator(schema).iter_errors(values), key=lambda error: line_of(node, list(error.absolute_path)))
    if not errors:
        return
    error = errors[0]
    # If a value matches none of several alternatives, the deepest error is the one to correct.
    while error.context:
        error = max(error.context, key=lambda each: len(each.absolute_path))
    place = list(error.absolute_path)
    message = _mistake(error, _validator(schema).schema.get("properties", {}))
    if error.validator == "additionalProperties":
        unknown = next(key for key in error.instance if key not in error.schema.get("properties", {}))
        # A key may be a number, which would be taken for an index.
        place.append(str(unknown))
    where = ".".join(str(part + 1) if isinstance(part, int) else str(part) for part in place)
    entry = f"{where}: " if where else ""
    raise UserError(f"{path}, line {line_of(node, place)}: {entry}{message}")


def line_of(node: Any, place: Sequence[str | int]) -> int:
    """Return the line number, counted from 1, of an entry. ``place`` contains the keys and indices that lead to the
    entry."""
    mark = None if node is None else node.start_mark
    for part in place:
        if node is None or not isinstance(node.value, list):
            break
        if isinstance(part, int):
            node = node.value[part]
            mark = node.start_mark
            continue
        key, node = next(((key, value) for key, value in node.value if str(key.value) == str(part)), (None, None))
        mark = mark if key is None else key.start_mark
    return 1 if mark is None else mark.line + 1


def _mistake(error: Any, top: Mapping[str, Any]) -> str:
    """Return the text of a schema error: what is wrong and what to do. ``top`` contains the keys of the whole file."""
    rule, value = error.validator, str(error.instance)
    value = value if len(value) <= 80 else f"{value[:77]}..."
    known: Mapping[str, Any] = error.schema.get("properties", {})
    advice = error.schema.get("description", "")
    if rule == "additionalProperties":
        unknown = str(next(key for key in error.instance if key not in known))
        if unknown in top:
            return "this key belongs at the top of the file, not here; remove it here, and give it once at the top"
        return f"unknown key{did_you_mean(unknown, known)}; give one of {', '.join(known)}"
    if rule == "required":
        missing = next(key for key in error.validator_value if key not in error.instance)
        return f"{missing} is missing; {known[missing].get('description', 'give it')}"
    if rule == "type" and error.validator_value == "string" and isinstance(error.instance, bool | int | float):
        return f"{value} is not a string; put it in quotes"
    kind = {"array": "list", "object": "mapping"}.get(str(error.validator_value)) if rule == "type" else None
    if kind is not None and isinstance(error.instance, dict | list):
        found = "a mapping of keys to values" if isinstance(error.instance, dict) else "a list"
        return f"it is {found}, not a {kind}; {advice or 'correct it'}"
    return f"{value!r} is not valid; {advice or error.message[:200]}"


@cache
def _validator(schema: str) -> Any:
    # Imported here because the import is slow.
    from jsonschema import Draft202012Validator

    return Draft202012Validator(json.loads(resources.files("egs_warp.io").joinpath(schema).read_text("utf-8")))
