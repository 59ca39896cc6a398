import dataclasses
import tomllib

import pytest

from mapserver.config import ServerConfig, StoreConfig
from protocol.config import from_table, load_toml
from protocol.errors import ConfigError
from tests.paths import CONFIG

FILE = CONFIG / "server.toml"


def names(cls: type) -> dict[str, object]:
    """Options of a dataclass by name; tables as dictionaries."""
    default = cls()
    fields = ((f.name, getattr(default, f.name)) for f in dataclasses.fields(cls))
    return {name: names(type(value)) if dataclasses.is_dataclass(value) else None for name, value in fields}


def keys(table: dict[str, object]) -> dict[str, object]:
    return {name: keys(value) if isinstance(value, dict) else None for name, value in table.items()}


def leaves(table: dict[str, object]) -> int:
    return sum(leaves(value) if isinstance(value, dict) else 1 for value in table.values())


def test_the_file_equals_the_defaults():
    assert from_table(ServerConfig, load_toml(FILE), "server.toml") == ServerConfig()


def test_the_file_names_every_option():
    assert keys(load_toml(FILE)) == names(ServerConfig)


def test_every_option_of_the_file_has_a_comment():
    options = [line for line in FILE.read_text().splitlines() if "=" in line.partition("#")[0]]
    assert all("#" in line for line in options)
    assert len(options) == leaves(names(ServerConfig))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("query_threads = 0", "query_threads: 0"),
        ("query_threads = 65", "query_threads: 65"),
        ("threads = 2", "unknown key `threads`"),
        ("[fold]\nbucket_s = 1", "bucket_s: 1"),
        ("[fold]\nbucket_s = 7200", "bucket_s: 7200"),
        ("[fold]\nbucket_s = 700", "bucket_s: 700"),
        ("[fold]\nkeep_buckets = 0", "keep_buckets: 0"),
        ("[fold]\nkernel = 3", "unknown key `kernel`"),
        ("[change]\nvariation = 1.0", "variation: 1.0"),
        ("[change]\nsize_m = 0.0", "size_m"),
        ("[read]\nmin_weight_m = -1", "min_weight_m"),
        ("[store]\nqueue_batches = 0", "queue_batches"),
        ("[store]\nsnapshots = 0", "unknown key `snapshots`"),
    ],
)
def test_a_bad_option_is_refused_with_its_place(text, named):
    with pytest.raises(ConfigError, match=f"server.toml.*{named}"):
        from_table(ServerConfig, tomllib.loads(text), "server.toml")


@pytest.mark.parametrize("name", [f.name for f in dataclasses.fields(StoreConfig)])
@pytest.mark.parametrize("value", [0, -1])
def test_sizes_of_the_store_are_positive(name, value):
    with pytest.raises(ValueError, match=name):
        StoreConfig(**{name: value})
