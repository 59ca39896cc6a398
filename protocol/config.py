"""TOML to frozen dataclasses: types checked, unknown keys refused, every error located."""

import dataclasses
import json
import math
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from protocol.errors import ConfigError

T = TypeVar("T")


def from_table(cls: type[T], table: Mapping[str, Any], where: str) -> T:
    """Build the dataclass `cls` from a TOML table; ConfigError, also for a ValueError of `__post_init__`.

    where: place named by errors, such as `site.toml [server]`.
    """
    hints = typing.get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    if unknown := sorted(set(table) - set(fields)):
        raise ConfigError(where, f"unknown key `{unknown[0]}`; known: {', '.join(fields)}")
    for name, field in fields.items():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and name not in table:
            raise ConfigError(where, f"key `{name}` is missing")
    values = {name: _convert(value, hints[name], f"{where} {name}") for name, value in table.items()}
    try:
        return cls(**values)
    except ValueError as error:
        raise ConfigError(where, str(error)) from None


def toml_lines(values: Mapping[str, object]) -> list[str]:
    """Texts, numbers, lists as TOML, which writes them like JSON."""
    return [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in values.items()]


def section(table: dict[str, Any], name: str, where: str) -> dict[str, Any]:
    """Take the sub-table `name` out of `table`; empty if absent."""
    return _table(table.pop(name, {}), f"{where} {name}")


def _table(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(where, f"a table is expected, not {type(value).__name__}")
    return value


def _convert(value: Any, hint: Any, where: str) -> Any:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        return _convert(value, next(a for a in typing.get_args(hint) if a is not type(None)), where)
    if origin is tuple:
        return _convert_tuple(value, typing.get_args(hint), where)
    if origin is Mapping:
        _, kind = typing.get_args(hint)
        return {name: _convert(v, kind, f"{where}.{name}") for name, v in _table(value, where).items()}
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return from_table(hint, _table(value, where), where)
    if type(value) is int and value.bit_length() > 63:
        raise ConfigError(where, "a number of at most 64 bits is expected")
    if hint is float and type(value) is int:
        return float(value)
    if hint is float and type(value) is float and not math.isfinite(value):
        raise ConfigError(where, f"a finite number is expected, not {value}")
    if type(value) is not hint:
        shown = "" if isinstance(value, dict | list) else f" ({value!r:.80})"
        raise ConfigError(where, f"{hint.__name__} is expected, not {type(value).__name__}{shown}")
    return value


def _convert_tuple(value: Any, args: tuple[Any, ...], where: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise ConfigError(where, f"a list is expected, not {type(value).__name__}")
    if args[-1] is Ellipsis:
        return tuple(_convert(v, args[0], f"{where}[{i}]") for i, v in enumerate(value))
    if len(value) != len(args):
        raise ConfigError(where, f"{len(args)} values are expected, not {len(value)}")
    return tuple(_convert(v, a, f"{where}[{i}]") for i, (v, a) in enumerate(zip(value, args, strict=True)))


def require_between(config: Any, low: float, high: float, *names: str) -> None:
    """ValueError for the first named value outside the limits; None passes."""
    for name in names:
        value = getattr(config, name)
        if value is not None and not low <= value <= high:  # also false for NaN
            raise ValueError(f"{name}: {value!r} is not between {low:g} and {high:g}")


def require_positive(config: Any, names: Iterable[str]) -> None:
    """ValueError for the first named value not positive and finite."""
    for name in names:
        if not 0 < getattr(config, name) < math.inf:  # also false for NaN
            raise ValueError(f"{name}: must be positive and finite")
