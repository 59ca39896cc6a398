"""Images built and run by buildah, without an engine.

Where the base image cannot be fetched, a Debian of the same release takes its place.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Self

import pytest

from sitegrid.process.children import Child, Children
from tests.paths import ROOT

BASE = "docker.io/library/python:3.11-slim"
STAND_IN = "bookworm"
PACKAGES = "python3,python3-venv,python3-pip,ca-certificates"
OF_HOST = ("/etc/ssl/certs", "/etc/pip.conf")  # how this host reaches its package index
MOUNTS = tuple(word for path in OF_HOST if Path(path).exists() for word in ("--volume", f"{path}:{path}:ro"))
TOOLS = ("buildah", "mmdebstrap")
NEEDS_TOOLS = pytest.mark.skipif(not all(map(shutil.which, TOOLS)), reason=f"{' and '.join(TOOLS)} make the images")


class Images:
    """A storage of images, which leaving the block empties. folder: where it is."""

    def __init__(self, folder: Path) -> None:
        self._place = ("--root", str(folder / "images"), "--runroot", str(folder / "run"))
        self._folder = folder

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """A build that failed leaves its file system mounted, which no other test can remove."""
        self.run("rm", "--all")
        self.run("rmi", "--all", "--force")

    def command(self, *words: str) -> list[str]:
        """The command line of buildah."""
        return ["buildah", *self._place, *words]

    def run(self, *words: str) -> str:
        """What buildah prints; an error of its own stops the test."""
        done = subprocess.run(self.command(*words), cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{words}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
        return done.stdout.strip()

    def have_base(self) -> None:
        """Fetch the base image, or make its stand-in, where it is not there yet."""
        for words in (("inspect", "--type", "image", BASE), ("pull", "--quiet", BASE)):
            if subprocess.run(self.command(*words), capture_output=True, check=False).returncode == 0:
                return
        self.run("commit", "--quiet", "--rm", self.debian(STAND_IN), BASE)

    def debian(self, release: str) -> str:
        """A container of a release of Debian and its Python."""
        tree = self._folder / f"{release}.tar"
        subprocess.run(["mmdebstrap", "--variant=minbase", f"--include={PACKAGES}", release, tree], check=True)
        container = self.run("from", "scratch")
        self.run("add", "--quiet", container, str(tree), "/")
        tree.unlink()
        return container

    def build(self, target: str) -> str:
        """A container of a target of the Dockerfile."""
        words = ("--isolation", "chroot", "--layers", "--pull-never", *MOUNTS, "--target", target, "--tag", target)
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
