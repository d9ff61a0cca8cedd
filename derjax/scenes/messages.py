"""What is said about input files that are wrong: sentences that name file, table and key."""

import difflib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from ..core.errors import InputError
from .extensions import extension_names
from .parameters import PARAMETERS

T = TypeVar("T", bound=BaseModel)


def check(model: type[T], content: Mapping[str, Any], path: Path) -> T:
    """`content` as a `model`; `InputError` naming `path` and the keys at fault."""
    try:
        return checked(model, content)
    except InputError as error:
        lines = str(error).splitlines()
        raise InputError("\n".join(f"{path}: {line}" for line in lines)) from None


def checked(model: type[T], content: Mapping[str, Any]) -> T:
    """`content` as a `model`; `InputError` naming the keys at fault, one a line."""
    problems: list[str] = []
    for key in content.keys() & (model.model_fields.keys() - set(_known_keys(model))):
        problems.append(_unknown(model, [], key, content[key]))
    try:
        valid = model.model_validate(content)
    except ValidationError as error:
        problems += [_describe(model, p) for p in _meant(error.errors(), content)]
    else:
        if not problems:
            return valid
    raise InputError("\n".join(problems))


def _meant(problems: list[Any], content: Mapping[str, Any]) -> list[Any]:
    """What pydantic finds wrong, without what is only said because of something else.

    A key that takes one value or a list of them has problems as each of both: those as a list
    count if it is one. And a list is not too short for what is wrong with its entries.
    """
    chosen = []
    for problem in problems:
        place, forms = _place(problem["loc"], content)
        if all(form.startswith("tuple") == is_list for form, is_list in forms):
            chosen.append({**problem, "loc": place})
    places = [problem["loc"] for problem in chosen]
    return [
        problem
        for problem, place in zip(chosen, places, strict=True)
        if problem["type"] != "too_short"
        or not any(p[: len(place)] == place and len(p) > len(place) for p in places)
    ]


def _place(
    given: tuple[Any, ...], content: Mapping[str, Any]
) -> tuple[tuple[Any, ...], list[tuple[str, bool]]]:
    """A place that pydantic names, in terms of the file.

    Besides keys and numbers of entries it has the forms of values that a key may take, as
    'float' or 'tuple[float, ...]'. They are returned apart, each with whether the value is a list.
    """
    place, forms, value = [], [], content
    for k, part in enumerate(given):
        if isinstance(value, Mapping):
            value = value.get(part)
        elif isinstance(value, list | tuple) and isinstance(part, int):
            value = value[part] if part < len(value) else None
        elif k > 0:
            forms.append((str(part), isinstance(value, list | tuple)))
            continue
        place.append(part)
    return tuple(place), forms


def _describe(model: type[BaseModel], problem: Any) -> str:
    """One problem that pydantic found, as a sentence with the key in TOML's notation."""
    kind, given, place = problem["type"], problem["input"], list(problem["loc"])
    if kind == "extra_forbidden":
        return _unknown(model, place[:-1], str(place[-1]), given)
    if kind == "missing":
        return f"{_where(place)}: is missing"
    if kind in ("model_type", "model_attributes_type"):
        return f"{_where(place)}: should be a table, not {_toml(given)}"
    if kind == "value_error":
        if not isinstance(given, Mapping):
            return f"{_where(place)} = {_toml(given)}: {problem['ctx']['error']}"
        table = f"{_where(place, is_table=True)} " if place else ""
        return f"{table}{problem['ctx']['error']}"
    message = problem["msg"].removeprefix("Input ")
    if kind == "float_type" and isinstance(given, str) and _is_number(given):
        message += "; write it without quotes"
    parameter = PARAMETERS.get(str(place[-1]))
    if kind == "greater_than" and parameter is not None and parameter.unit == "m":
        message += "; lengths are in metres"
    return f"{_where(place)} = {_toml(given)}: {message}"


def _where(place: list[Any], is_table: bool = False) -> str:
    """A place in a file: `[table] key`, `[table] (entry 2) key.subkey`."""
    if len(place) == 1 and not is_table:
        return str(place[0])
    table, *keys = place
    words = "".join(f" (entry {k + 1}) " if isinstance(k, int) else f".{k}" for k in keys)
    return f"[{table}] {words.strip('. ').replace(') .', ') ')}".strip()


def _toml(value: Any) -> str:
    """A value as it stands in a TOML file, if it is short."""
    text = json.dumps(value, default=str) if isinstance(value, str | bool | list) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _unknown(model: type[BaseModel], tables: list[Any], key: str, given: Any) -> str:
    """What to say about a key that does not exist: where it belongs, or what was meant."""
    known = [*_known_keys(model, tables), *(() if tables else model_tables(model))]
    close = difflib.get_close_matches(key, known, n=1)
    if isinstance(given, Mapping) and not tables:
        hint = f" Did you mean [{close[0]}]?" if close else ""
        return f"[{key}]: unknown table.{hint} Known tables: {', '.join(known)}"
    where = _where([*tables, key])
    homes = [name for name in _known_keys(model) if key in _known_keys(model, [name])]
    if homes:
        return f"{where}: unknown key. It belongs in the table [{homes[0]}]"
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return f"{where}: unknown key.{hint} Known keys: {', '.join(known)}"


def model_tables(model: type[BaseModel]) -> tuple[str, ...]:
    """Tables that a file may have beyond the fields of its model."""
    return extension_names() if "extensions" in model.model_fields else ()


def _known_keys(model: type[BaseModel], tables: list[Any] | None = None) -> list[str]:
    """The keys of the table that is reached from `model` through `tables`; none if no table."""
    for table in tables or []:
        if not isinstance(table, str):
            continue
        pending, found = [model.model_fields[table].annotation], None
        while pending and found is None:
            part = pending.pop()
            if isinstance(part, type) and issubclass(part, BaseModel):
                found = part
            pending.extend(getattr(part, "__args__", ()))
        if found is None:
            return []
        model = found
    return [name for name, field in model.model_fields.items() if not field.exclude]
