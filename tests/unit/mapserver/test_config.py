import dataclasses
import tomllib

import pytest

from mapserver.config import ServerConfig
from protocol.config import from_table
from protocol.errors import ConfigError
from protocol.files import load_toml
from tests.paths import CONFIG

FILE = CONFIG / "server.toml"


def names(cls: type) -> dict[str, object]:
    default = cls()
    fields = ((f.name, getattr(default, f.name)) for f in dataclasses.fields(cls))
    return {name: names(type(value)) if dataclasses.is_dataclass(value) else None for name, value in fields}


def keys(table: dict[str, object]) -> dict[str, object]:
    return {name: keys(value) if isinstance(value, dict) else None for name, value in table.items()}


def test_the_file_names_every_option_with_its_default_and_a_comment():
    assert from_table(ServerConfig, load_toml(FILE), "server.toml") == ServerConfig()
    assert keys(load_toml(FILE)) == names(ServerConfig)
    options = [line for line in FILE.read_text().splitlines() if "=" in line.partition("#")[0]]
    assert all("#" in line for line in options)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("query_threads = 0", "query_threads: 0"),
        ("threads = 2", "unknown key `threads`"),
        ("[fold]\nbucket_s = 1", "bucket_s: 1"),
        ("[fold]\nbucket_s = 700", "bucket_s: 700"),
        ("[fold]\nkeep_hours = 0", "keep_hours: 0"),
        ("[fold]\nkeep_days = 1001", "keep_days: 1001"),
        ("[fold]\nstd_cap_m = 0.3", "std_cap_m"),
        ("[change]\nsize_m = nan", "size_m"),
        ("[read]\nmin_weight_m = -1", "min_weight_m"),
        ("[store]\nsnapshot_s = 0", "snapshot_s"),
        ("[store]\narchive_after_h = nan", "archive_after_h"),
        ("[trust]\njudge_s = -1", "judge_s"),
        ("[trust]\nexclude = 1", "exclude: bool is expected"),
    ],
)
def test_a_bad_option_is_refused_with_its_place(text, named):
    with pytest.raises(ConfigError, match=f"server.toml.*{named}"):
        from_table(ServerConfig, tomllib.loads(text), "server.toml")
