from collections.abc import Mapping
from dataclasses import dataclass, field

import pytest

from protocol.config import from_table, section
from protocol.errors import ConfigError


@dataclass(frozen=True)
class Inner:
    depth_m: float = 1.0


@dataclass(frozen=True)
class Outer:
    name: str
    count: int = 1
    ratio: float = 0.5
    on: bool = False
    maybe: float | None = None
    triple: tuple[float, float, float] = (0.0, 0.0, 0.0)
    many: tuple[int, ...] = ()
    inner: Inner = field(default_factory=Inner)
    inners: tuple[Inner, ...] = ()
    named: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ValueError(f"count: {self.count} is negative")


def test_values_and_defaults():
    table = {"name": "a", "ratio": 2, "maybe": 3, "triple": [1, 2.5, 3], "many": [4, 5], "inner": {"depth_m": 7}}
    assert from_table(Outer, {**table, "inners": [{}, {"depth_m": 2}], "named": {"b": 1}}, "x.toml") == Outer(
        "a",
        ratio=2.0,
        maybe=3.0,
        triple=(1.0, 2.5, 3.0),
        many=(4, 5),
        inner=Inner(7.0),
        inners=(Inner(), Inner(2.0)),
        named={"b": 1.0},
    )


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({}, ["x.toml", "`name` is missing"]),
        ({"name": "a", "nmae": 1}, ["unknown key `nmae`", "name, count"]),
        ({"name": 1}, ["x.toml name", "str is expected, not int"]),
        ({"name": "a", "count": True}, ["count", "int is expected, not bool"]),
        ({"name": "a", "ratio": "1"}, ["ratio", "float is expected, not str"]),
        ({"name": "a", "ratio": float("nan")}, ["ratio", "finite"]),
        ({"name": "a", "triple": [1, 2]}, ["triple", "3 values are expected, not 2"]),
        ({"name": "a", "triple": [1, "b", 3]}, ["triple[1]", "float is expected"]),
        ({"name": "a", "triple": "1, 2, 3"}, ["x.toml triple: a list is expected, not str"]),
        ({"name": "a", "inner": 1}, ["inner", "a table is expected"]),
        ({"name": "a", "inner": {"deep": 1}}, ["x.toml inner", "unknown key `deep`"]),
        ({"name": "a", "named": [1]}, ["x.toml named", "a table is expected, not list"]),
        ({"name": "a", "named": {"b": "c"}}, ["x.toml named.b", "float is expected, not str"]),
        ({"name": "a", "count": -1}, ["x.toml", "count: -1 is negative"]),
    ],
)
def test_error_names_the_place_and_the_problem(table, words):
    with pytest.raises(ConfigError) as caught:
        from_table(Outer, table, "x.toml")
    for word in words:
        assert word in str(caught.value)


def test_section_is_taken_out():
    table = {"a": {"x": 1}, "b": 2}
    assert section(table, "a", "x.toml") == {"x": 1}
    assert section(table, "c", "x.toml") == {}
    assert table == {"b": 2}
    with pytest.raises(ConfigError, match="a table is expected"):
        section(table, "b", "x.toml")
