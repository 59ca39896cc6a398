"""Images built and run by buildah, without an engine.

Where the base image cannot be fetched, a Debian of the same release takes its place.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path

from sitegrid.process.children import Child, Children
from tests.paths import ROOT

BASE = "docker.io/library/python:3.11-slim"
STAND_IN = ("bookworm", "python3,python3-venv,python3-pip,ca-certificates")
OF_HOST = ("/etc/ssl/certs", "/etc/pip.conf")  # how this host reaches its package index


class Images:
    """A storage of images. folder: where it is."""

    def __init__(self, folder: Path) -> None:
        self._place = ("--root", str(folder / "images"), "--runroot", str(folder / "run"))
        self._folder = folder

    def command(self, *words: str) -> list[str]:
        """The command line of buildah."""
        return ["buildah", *self._place, *words]

    def run(self, *words: str) -> str:
        """What buildah prints; an error of its own stops the test."""
        done = subprocess.run(self.command(*words), cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{words}: {done.stderr[-2000:]}"
        return done.stdout.strip()

    def have_base(self) -> None:
        """Fetch the base image, or make its stand-in, where it is not there yet."""
        for words in (("inspect", "--type", "image", BASE), ("pull", "--quiet", BASE)):
            if subprocess.run(self.command(*words), capture_output=True, check=False).returncode == 0:
                return
        release, packages = STAND_IN
        tree = str(self._folder / "base.tar")
        subprocess.run(["mmdebstrap", "--variant=minbase", f"--include={packages}", release, tree], check=True)
        container = self.run("from", "scratch")
        self.run("add", "--quiet", container, tree, "/")
        self.run("commit", "--quiet", "--rm", container, BASE)

    def build(self, target: str) -> str:
        """A container of a target of the Dockerfile."""
        mounts = [word for path in OF_HOST if Path(path).exists() for word in ("--volume", f"{path}:{path}:ro")]
        words = ("--isolation", "chroot", "--layers", "--pull-never", *mounts, "--target", target, "--tag", target)
        self.run("bud", *words, ".")
        return self.run("from", "--pull-never", f"localhost/{target}")

    def settings(self, container: str) -> dict[str, object]:
        """What the image says: user, labels, entry point."""
        settings: dict[str, object] = json.loads(self.run("inspect", container))["OCIv1"]["config"]
        return settings

    def megabytes(self, image: str) -> float:
        """Size of an image, all layers."""
        (row,) = json.loads(self.run("images", "--json", image))
        number, unit = row["size"].split()
        return float(number) * {"KB": 1e-3, "MB": 1.0, "GB": 1e3}[unit]


class Container(Child):
    """A program that runs in a container; its words are those of buildah."""

    def _started(self, words: list[str]) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=self._errors, start_new_session=True
        )

    def send(self, number: signal.Signals) -> None:
        """To all of its processes: buildah does not hand on signals."""
        if self.code is None:
            os.killpg(self.pid, number)


class Containers(Children):
    """Containers of a test; leaving the block ends them."""

    child = Container
