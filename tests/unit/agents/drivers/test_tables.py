from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from agents.config import load_agent
from agents.drivers import Observed, tables
from agents.drivers.tables import DriverConfig, known_kinds, open_sources
from protocol.errors import ConfigError
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Payload
from tests.unit.agents.drivers.frames import Script, no_bundles

MACHINE = """
[machine]
name = "loader-1"
[[sensor]]
name = "gps-1"
kind = "gps"
[[sensor]]
name = "compass"
kind = "attitude"
"""


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ({"kind": "nme"}, "kind: 'nme' is none of nmea, ubx, gpsd, can, zenoh"),
        ({"address": "tcp://10.0.0.7"}, "address: 'tcp://10.0.0.7' is neither tcp://HOST:PORT nor"),
        ({"address": ""}, "address: '' is neither a port"),
        ({"baud": -3}, "baud: -3 is no baud; 0 finds it"),
        ({"kind": "zenoh"}, "zenoh has none, its bundles come on the machine's own key"),
        ({"options": {"a": "b"}}, "options: of plug-ins alone, ubx has none"),
        ({"feeds": {"fixes": "gps-1"}}, "'fixes' is no stream; there are fix, velocity, heading, imu, wheels"),
        ({"feeds": {"fix": "gps-2"}}, "feeds.fix: no [[sensor]] is named 'gps-2'"),
        ({"feeds": {"fix": "compass"}}, "compass is of kind attitude, and a fix feeds one of kind gps"),
        ({"feeds": {"heading": "compass"}}, 'give compass `measures = ["heading"]`'),
        ({"feeds": {"fix": "gps-1", "gp:fix": "gps-1"}}, "two streams feed gps-1"),
        ({"kind": "gpsd", "feeds": {"fix": "gps-1"}}, "give gps-1 its `std = { position = ... }`"),
    ],
)
def test_a_table_that_is_wrong_is_refused_in_a_sentence(tmp_path: Path, keys: dict[str, object], problem: str) -> None:
    path = tmp_path / "agent.toml"
    values = {"kind": "ubx", "address": "/dev/ttyACM0", **keys}
    lines = [f"{name} = {_toml(value)}" for name, value in values.items()]
    path.write_text("\n".join([MACHINE, "[[driver]]", *lines]))
    with pytest.raises(ConfigError) as caught:
        load_agent(path)
    assert problem in str(caught.value)
    assert str(path) in str(caught.value)


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f'"{key}" = "{name}"' for key, name in value.items()) + "}"
    return str(value) if isinstance(value, int) else f'"{value}"'


class Scale(Script):
    """A plug-in: a scale with one value."""

    def __init__(self, table: DriverConfig, machine: MachineConfig) -> None:
        value = Observed(machine.sensors[0].name, "payload", (float(table.options["kg"]),), 5 * 10**9)
        super().__init__([[value]])


def test_a_plug_in_is_a_kind_and_without_receivers_its_time_is_the_host_s_as_it_was_at_the_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tables, "entry_points", lambda **_: [EntryPoint("scale", f"{__name__}:Scale", tables.PLUG_INS)])
    monkeypatch.setattr(EntryPoint, "load", lambda _: Scale)
    assert known_kinds()[-1] == "scale"
    machine = MachineConfig("loader-1", sensors=(SensorConfig("scale-1", "payload"),))
    table = DriverConfig("scale", "canister", options={"kg": "1200"})
    utc_ns = 1_795_688_127 * 10**9
    driver, readings = open_sources([table], machine, lambda: (utc_ns, 3 * 10**9), no_bundles), []
    while (piece := driver.read(5.0)) is not None:
        readings += piece
    driver.close()
    assert readings == [Payload("scale-1", utc_ns + 2 * 10**9, 1200.0)]
