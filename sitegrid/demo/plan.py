"""What the demo runs, and where its files lie."""

from __future__ import annotations

import shutil
from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path

from protocol.errors import ConfigError
from protocol.machine.log_folder import LogFolder, open_log
from protocol.wire.session import free_endpoint
from sim.agent_files import write_configs
from sim.config import SimConfig, resolve
from sim.scenario.tables import Scenario

DEFAULT_MANIFEST = Path("evaluation/logs/rl_test1_husky/log.toml")
DEFAULT_DATA = Path("../shared/data/rl_test1_husky")
SIM_OPTIONS = ("scenario", "world", "machines", "seed", "seconds", "speed")  # those that the demo passes on


@dataclass(frozen=True)
class DemoPlan:
    """One demo. out, work: folders of pictures and of all else. configs: a file per machine. log: replayed beside."""

    out: Path
    work: Path
    endpoint: str
    config: SimConfig
    scenario: Scenario
    configs: list[Path]
    log: LogFolder | None
    manifest: Path | None

    @property
    def site_file(self) -> Path:
        """The simulated site."""
        return self.work / "site.toml"

    @property
    def truth(self) -> Path:
        """The folder of the simulation's true map and tracks."""
        return self.work / "truth"

    @property
    def true_map(self) -> Path:
        """The true map of the simulation."""
        return self.truth / "truth_map.npz"


def make_plan(arguments: Namespace) -> DemoPlan:
    """The plan of the options; clears the folder of an earlier run and writes the machines' configurations."""
    try:
        config = SimConfig(**{name: getattr(arguments, name) for name in SIM_OPTIONS})
    except ValueError as error:
        raise ConfigError("sitegrid demo", str(error)) from None
    scenario = resolve(config)
    work = arguments.out / "work"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    manifest, data = _log_of(arguments)
    log = open_log(manifest, data) if manifest else None
    return DemoPlan(arguments.out, work, free_endpoint(), config, scenario, write_configs(config, work), log, manifest)


def _log_of(arguments: Namespace) -> tuple[Path | None, Path | None]:
    """The log to replay: as asked for, or the default one where its data lies."""
    if arguments.log and not arguments.no_log:
        return arguments.log, arguments.data
    default = not arguments.no_log and DEFAULT_MANIFEST.exists() and DEFAULT_DATA.exists()
    return (DEFAULT_MANIFEST, DEFAULT_DATA) if default else (None, None)
