"""Images are built for real, and a site of containers draws a map: without an engine, by buildah."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from protocol.queries.roads import WorklistQuery
from protocol.wire.session import free_endpoint
from sitegrid import connect
from tests.patience import PATIENCE_S, until
from tests.release.images import BASE, NEEDS_TOOLS, Containers, Images
from tests.release.stores import version

pytestmark = [
    pytest.mark.processes,
    pytest.mark.nightly,
    pytest.mark.timeout(3600),
    NEEDS_TOOLS,
]
MOST_MB = {"agent": 200, "server": 840, "sim": 700}  # above the base; lab/results/speed.md has the goals


@dataclass(frozen=True)
class Built:
    images: Images
    containers: dict[str, str]

    def words(self, target: str, *words: str) -> list[str]:
        """The command line of a program in a container of a target, as an engine would start it."""
        container = self.containers[target]
        entry = self.images.settings(container)["Entrypoint"]
        assert isinstance(entry, list)
        return self.images.command("run", "--isolation", "chroot", container, "--", *entry, *words)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Built]:
    with Images(tmp_path_factory.mktemp("images")) as images:
        images.have_base()
        yield Built(images, {target: images.build(target) for target in MOST_MB})


@pytest.mark.parametrize("target", MOST_MB)
def test_an_image_is_small_and_says_what_it_is(built: Built, target: str) -> None:
    settings = built.images.settings(built.containers[target])
    assert settings["User"] == "10001"
    labels = settings["Labels"]
    assert isinstance(labels, dict)
    assert labels["org.opencontainers.image.version"] == version()
    assert labels["org.opencontainers.image.title"]
    above = built.images.megabytes(f"localhost/{target}") - built.images.megabytes(BASE)
    print(f"{target}: {above:.0f} MB above its base")
    assert above <= MOST_MB[target]


def test_a_site_of_containers_draws_a_map_and_its_server_compiles_nothing(built: Built, tmp_path: Path) -> None:
    endpoint = free_endpoint()
    place = ("--endpoint", endpoint, "--site-file", "config/site.toml")
    said: list[dict[str, object]] = []
    with Containers(tmp_path, said.append) as containers:
        router = containers.start("router", *built.words("server", "router", "--listen", endpoint, "--insecure"))
        router.expect("ready", PATIENCE_S)
        server = containers.start("server", *built.words("server", "server", *place, "--store", "/data/store"))
        server.expect("ready", PATIENCE_S)
        with connect(endpoint, "paper", timeout_s=PATIENCE_S) as client:
            assert client.info().samples_merged == 0
            names = [f"loader-{i}" for i in (1, 2, 3)]
            for name in names:
                files = ("--config", "config/agent.toml", "--name", name, "--spool", f"/data/{name}.db")
                containers.start(name, *built.words("agent", "agent", *place, *files)).expect("ready", PATIENCE_S)
            words = ("--endpoint", endpoint, "--config", "config/sim.toml", "--seconds", "0", "--speed", "4")
            containers.start("sim", *built.words("sim", "sim", *words))
            until(lambda: set(client.info().machines) == set(names), "samples of all machines")
            assert client.ask(WorklistQuery()).store == client.info().store
        assert not [line for line in [*said, *server.lines()] if "compiling" in line], "kernels come with the image"
