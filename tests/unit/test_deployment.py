"""compose.yaml and Dockerfile without Docker: schema, lint, commands parsed."""

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from protocol.site.site_file import load_site
from sitegrid.process.lifetime import END_S
from tests.integration import compose_run
from tests.paths import ROOT

COMPOSE, DOCKERFILE = ROOT / "compose.yaml", ROOT / "Dockerfile"
MACHINES = ["loader-1", "loader-2", "loader-3"]


def tool(name: str) -> str:
    """The tool beside this Python, or on the path."""
    path = shutil.which(name, path=str(Path(sys.executable).parent)) or shutil.which(name)
    if not path:
        pytest.skip(f"{name} is not installed")
    return path


def services() -> dict:
    pytest.importorskip("ruamel.yaml", reason="comes with check-jsonschema")
    return compose_run.load(COMPOSE)


def is_database(service: dict) -> bool:
    return service["image"].startswith("postgres:")


def commands() -> list[list[str]]:
    """Words after `sitegrid` of all commands and health checks."""
    commands = [list(service["command"]) for service in services().values() if not is_database(service)]
    checks = [service["healthcheck"]["test"] for service in services().values() if "healthcheck" in service]
    return commands + [list(test[2:]) for test in checks if test[1] == "sitegrid"]


def test_compose_file_follows_the_specification():
    command = [tool("check-jsonschema"), "--builtin-schema", "vendor.compose-spec", str(COMPOSE)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_dockerfile_is_clean():
    done = subprocess.run([tool("hadolint"), str(DOCKERFILE)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_command_is_one_that_the_parser_takes():
    import sitegrid.command_line

    parser = sitegrid.command_line.build_parser()
    words = commands()
    assert len(words) == len(services()) - 2 + 3, "less the databases, and with three health checks"
    for line in words:
        parser.parse_args(line)  # a usage error exits and fails the test


def test_everybody_meets_at_the_router():
    listen = commands()[0]
    assert listen[listen.index("--listen") + 1] == "tcp/0.0.0.0:7447"
    for line in commands()[1:]:
        assert line[line.index("--endpoint") + 1] == "tcp/router:7447"


def test_files_that_commands_name_exist():
    for line in commands():
        for word in line:
            assert not word.startswith("config/") or (ROOT / word).is_file(), f"{word} is missing"


def test_each_agent_has_a_name_and_a_spool_of_its_own():
    agents = {name: service["command"] for name, service in services().items() if service["command"][0] == "agent"}
    assert list(agents) == MACHINES
    for name, line in agents.items():
        assert line[line.index("--name") + 1] == name
        assert line[line.index("--spool") + 1] == f"/data/{name}.db"


def test_agents_and_simulator_mean_the_same_machines_and_site():
    from sim.config import load_sim, resolve

    scenario = resolve(load_sim(ROOT / "config" / "sim.toml"))
    assert list(scenario.machine_names) == MACHINES
    site = load_site(ROOT / "config" / "site.toml")
    assert (site.name, site.frame) == (scenario.site.name, scenario.site.frame)


def test_services_restart_and_need_no_privileges():
    for name, service in services().items():
        assert service["restart"] == ("no" if is_database(service) else "unless-stopped"), name
        assert service["cap_drop"] == ["ALL"], name
        assert service["read_only"] is True, name
    assert re.search(r"^USER (?!root)", DOCKERFILE.read_text(), re.MULTILINE)


def test_a_primary_that_died_never_comes_back_by_itself():
    """Its replica may have been promoted."""
    assert {name for name, service in services().items() if service["restart"] == "no"} == {"db-a", "db-b"}


def test_profile_ha_has_two_servers_of_one_journal_and_not_the_one_without_database():
    started = compose_run.needed(services(), "sim", "follower")
    assert set(started) == {"router", "db-a", "db-b", "server-a", "server-b", "follower", "sim", *MACHINES}
    lines = [started[name]["command"] for name in ("server-a", "server-b", "follower")]
    journals = {line[line.index("--journal") + 1] for line in lines}
    assert len(journals) == 1
    assert [started[name]["volumes"] for name in ("server-a", "server-b")] == [["map-a:/data"], ["map-b:/data"]]
    of_demo, of_site = (set(compose_run.needed(services(), profile=name)) for name in ("demo", "site"))
    assert of_demo == {"router", "server", "web", "sim", *MACHINES}
    assert of_site == {"router", "server", "web"}
    of_ha = set(compose_run.needed(services(), profile="ha"))
    assert of_ha == set(started) - {"sim", *MACHINES} | {"web"}
    for name, service in services().items():  # or Compose refuses the file
        for other in service.get("depends_on", {}):
            assert set(service["profiles"]) <= set(services()[other]["profiles"]), (name, other)


def test_the_journal_of_profile_ha_is_at_both_databases_and_goes_to_the_one_that_takes_commits():
    line = services()["server-a"]["command"]
    url = line[line.index("--journal") + 1]
    assert url.endswith("?target_session_attrs=read-write")
    for name in ("db-a", "db-b"):
        words = services()[name]["command"]
        assert f"{name}:{words[words.index('-p') + 1]}" in url


def test_only_this_host_gets_in_while_there_are_no_keys():
    for name, service in services().items():
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", [])), name
    assert ("--insecure" in commands()[0]) != ("--keys" in commands()[0])


def test_each_image_has_the_extras_of_its_commands_in_compose_and_the_version():
    import sitegrid.command_line

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    installed = re.findall(r'AS build-(\w+)\nRUN \$INSTALL "\.\[(.*)\]"', DOCKERFILE.read_text())
    parser = sitegrid.command_line.build_parser()
    for target, names in installed:
        extras = set(names.split(","))
        extras |= set(re.findall(r"\w+", str([project["optional-dependencies"][name] for name in extras])))
        images = {"image": f"sitegrid-{target}:{project['version']}", "build": {"context": ".", "target": target}}
        lines = [one["command"] for one in services().values() if one.get("build") == images["build"]]
        assert {one["image"] for one in services().values() if one.get("build") == images["build"]} == {images["image"]}
        assert {parser.parse_args(line).extra for line in lines} - {""} <= extras, target
    assert {one["build"]["target"] for one in services().values() if "build" in one} == {name for name, _ in installed}
    assert f'version="{project["version"]}"' in DOCKERFILE.read_text()


def test_processes_get_the_time_that_they_take_to_end():
    for name, service in services().items():
        assert float(service["stop_grace_period"].removesuffix("s")) >= END_S + 2, name


def test_image_holds_every_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packages = {name.removesuffix("*") for name in project["tool"]["setuptools"]["packages"]["find"]["include"]}
    copied = set(re.findall(r"^COPY (\w+) \1$", DOCKERFILE.read_text(), re.MULTILINE))
    assert packages <= copied
    kept = set(re.findall(r"^!(.+)$", (ROOT / ".dockerignore").read_text(), re.MULTILINE))
    assert packages | {"pyproject.toml", "constraints.txt", project["project"]["readme"], "config"} <= kept
