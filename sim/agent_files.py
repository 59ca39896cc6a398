"""What agents of simulated machines are given: a file of the site, and one of each machine."""

from __future__ import annotations

from pathlib import Path

from protocol.machine.machine_config import machine_toml
from protocol.site.site_config import site_toml
from sim.config import SimConfig, resolve


def write_configs(config: SimConfig, folder: Path) -> list[Path]:
    """Write `site.toml` and `<machine>.toml` for the agents: nominal values, nothing of the truth."""
    scenario = resolve(config)
    machines = [rig.machine for rig in scenario.rigs()]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "site.toml").write_text(site_toml(scenario.site), encoding="utf-8")
    paths = [folder / f"{machine.name}.toml" for machine in machines]
    for path, machine in zip(paths, machines, strict=True):
        path.write_text(machine_toml(machine), encoding="utf-8")
    return paths
