"""Options of an agent (config/agent.toml): machine, sensors, and a table per stage."""

from dataclasses import dataclass, field
from pathlib import Path

from agents.corrections.delivery import CorrectionsConfig
from agents.delivery.spool import SpoolConfig
from agents.delivery.uplink import UplinkConfig
from agents.drivers.formats.framing import GPSD
from agents.drivers.formats.gpsd import GPSD_PORT
from agents.drivers.tables import DriverConfig, check_drivers
from agents.holdout import HoldoutConfig
from agents.localisation.localiser import LocalisationConfig
from agents.positioning import PipelineConfig
from agents.recorder import RecordConfig
from protocol.config import from_table, section
from protocol.errors import ConfigError
from protocol.files import load_toml
from protocol.machine.machine_config import ABSOLUTE, MachineConfig, SensorConfig, parse_machine

# Lag of samples: the map server excludes machines 300 s behind others, as of a wrong clock.
MOST_LAG_S = 180.0


@dataclass(frozen=True)
class AgentConfig:
    """Options of one agent.

    driver: source of its sensors; empty: bundles on its key `sensors`. record: where readings are recorded. linger_s:
    final wait for acknowledgements.
    """

    pipeline: PipelineConfig = field(default_factory=PipelineConfig)
    spool: SpoolConfig = field(default_factory=SpoolConfig)
    uplink: UplinkConfig = field(default_factory=UplinkConfig)
    holdout: HoldoutConfig = field(default_factory=HoldoutConfig)
    corrections: CorrectionsConfig = field(default_factory=CorrectionsConfig)
    record: RecordConfig = field(default_factory=RecordConfig)
    linger_s: float = 30.0
    driver: tuple[DriverConfig, ...] = ()

    def __post_init__(self) -> None:
        if self.linger_s < 0:
            raise ValueError("linger_s: negative")
        gpsd = {driver.address for driver in self.driver if driver.kind == GPSD}
        for port in self.corrections.ports:
            if port in gpsd or (port.startswith("tcp://") and port.endswith(f":{GPSD_PORT}")):
                raise ValueError(f"corrections.ports: {port} is gpsd, which takes none: name the receiver's own port")
        if self.pipeline.localisation.smoothing_s > MOST_LAG_S:
            problem = f"at most {MOST_LAG_S:g} s: the map server would take the clock for wrong"
            raise ValueError(f"pipeline.localisation.lag_s: {problem}")


def require_place(machine: MachineConfig, config: LocalisationConfig) -> None:
    """Refuse a machine without any source of position; ConfigError."""
    if not config.start and not any(s.kind == "gps" and s.use and s.mode == ABSOLUTE for s in machine.sensors):
        problem = "no sensor in use shows its place, so it would never have a pose: give it a `gps`, or its `start`"
        raise ConfigError(machine.name, f"{problem} ([pipeline.localisation])")


def load_agent(path: Path) -> tuple[MachineConfig | None, AgentConfig]:
    """Read an agent's file: machine with sensors (None without [machine]), and options."""
    table, where = load_toml(path), str(path)
    machine = section(table, "machine", where)
    sensors = table.pop("sensor", [])
    if not isinstance(sensors, list):
        raise ConfigError(where, "sensors are written as [[sensor]]")
    config = from_table(AgentConfig, table, where)
    if sensors and not machine:
        raise ConfigError(where, "[[sensor]] without a [machine] that carries it")
    parsed = tuple(from_table(SensorConfig, s, f"{where} [[sensor]] {i + 1}") for i, s in enumerate(sensors))
    parsed_machine = parse_machine(machine, parsed, where) if machine else None
    if parsed_machine:
        check_drivers(config.driver, parsed_machine, where)
    return parsed_machine, config
