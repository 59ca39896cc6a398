"""Suite of a checkout: tests by line, durations, and whether they catch a fault."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from coverage import CoverageData

from tests.planted.faults import PACKAGES, Fault

LIMIT_S = 1800.0  # of one trial; longer is a hang
NIGHTLY = "nightly"
NO_TESTS = 5  # pytest's exit code for an empty selection


@dataclass(frozen=True)
class Suite:
    """Tests of a checkout. folder: of durations, coverage, and copies with planted faults.

    tests: files and folders. quick: without coverage.
    """

    root: Path
    folder: Path
    tests: tuple[str, ...] = ("tests",)
    quick: bool = False

    @property
    def coverage_file(self) -> Path:
        """Tests by line."""
        return self.folder / "coverage.sqlite"

    @property
    def times_file(self) -> Path:
        """Durations and results."""
        return self.folder / "times.xml"

    def copy(self, number: int) -> Path:
        """A copy of the checkout, made on demand; later ones include compiled kernels."""
        copy = self.folder / f"tree-{number}"
        if copy.exists():
            return copy
        if number:
            return Path(shutil.copytree(self.copy(0), copy))
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=self.root, capture_output=True, check=True, text=True)
        for name in filter(None, listed.stdout.split("\0")):
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(self.root / name, copy / name)
        return copy

    def measure(self, processes: int) -> None:
        """Run the whole suite with coverage by test, unless done."""
        if self.times_file.exists():
            return
        words = [f"--cov={package}" for package in PACKAGES]
        part = self.times_file.with_suffix(".part")
        words += ["--cov-context=test", "--cov-report=", f"--junitxml={part}", f"--numprocesses={processes}"]
        words += ["--dist=worksteal", "-o", "junit_family=xunit1", *self.tests]
        environment = {"COVERAGE_FILE": str(self.coverage_file)}
        done = _pytest(self.copy(0), words, environment)
        print(done.stdout.rpartition("\n\n")[2], flush=True)
        part.rename(self.times_file)

    @cached_property
    def seconds(self) -> dict[str, float]:
        """Durations of passing tests by id, if pytest finds them by it."""
        times = {}
        for case in ET.parse(self.times_file).getroot().iter("testcase"):
            if not [child for child in case if child.tag in ("failure", "error", "skipped")]:
                module = Path(str(case.get("file")))
                inner = str(case.get("classname")).removeprefix(".".join(module.with_suffix("").parts)).strip(".")
                names = [module.as_posix(), *filter(None, inner.split(".")), str(case.get("name"))]
                times["::".join(names)] = float(case.get("time", 0.0))
        known = self._collected()
        return {test: seconds for test, seconds in times.items() if test in known}

    @cached_property
    def nightly(self) -> set[str]:
        """Ids of tests in `make nightly` only."""
        return self._collected("-m", NIGHTLY)

    def _collected(self, *words: str) -> set[str]:
        shown = _pytest(self.copy(0), ["--collect-only", "--quiet", *words, *self.tests], {}).stdout
        return {line for line in shown.splitlines() if "::" in line}

    @cached_property
    def _data(self) -> CoverageData:
        data = CoverageData(str(self.coverage_file))
        data.read()
        return data

    def tests_of(self, fault: Fault) -> list[str]:
        """Tests or folders that may catch a fault, likeliest first; KeyError without a place.

        Those that ran its lines. Compiled code and constants leave no trace: then those that ran its module, or its
        mirroring test folder.
        """
        root = self.copy(0)
        if (place := fault.place(root)) is None:
            raise KeyError(fault.name)
        module = place.path.relative_to(root)
        mirror = f"tests/unit/{module.parent.as_posix()}/"
        named = f"{mirror}test_{module.stem}.py"
        if self.quick:
            package = f"tests/unit/{module.parts[0]}"
            return [path for path in dict.fromkeys([named, mirror, package]) if (root / path).exists()]
        lines = self._data.contexts_by_lineno(str(place.path))
        wanted = range(place.lines[0], place.lines[1] + 1)
        of_lines = _ids(lines, wanted)
        ids = of_lines or _ids(lines, lines) | {test for test in self.seconds if test.startswith(mirror)}
        own = [test for test in self.seconds if test in ids]
        return sorted(own, key=lambda t: (not t.startswith(named), not t.startswith(mirror), self.seconds[t]))


def trial(tree: Path, fault: Fault, tests: Sequence[str]) -> str:
    """The test that catches a fault in a copy of the checkout, or empty."""
    place = fault.place(tree)
    assert place is not None
    original, stat = place.path.read_bytes(), place.path.stat()
    try:
        place.path.write_bytes(original[: place.start] + place.text + original[place.end :])
        done = _pytest(tree, ["--exitfirst", "--quiet", *tests], {}, LIMIT_S)
    except subprocess.TimeoutExpired:
        return "it hangs"
    finally:
        place.path.write_bytes(original)
        os.utime(place.path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    if done.returncode in (0, NO_TESTS):
        return ""
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return failed.group(1) if failed else f"pytest ends with {done.returncode}"


def _ids(contexts: dict[int, list[str]], lines: Sequence[int] | dict[int, list[str]]) -> set[str]:
    """Tests with contexts on these lines."""
    return {context.partition("|")[0] for line in lines for context in contexts.get(line, []) if context}


def _pytest(
    tree: Path, words: Sequence[str], environment: dict[str, str], limit_s: float | None = None
) -> subprocess.CompletedProcess[str]:
    """Run pytest in a checkout without byte code, so that faults do not outlive their trial."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:randomly", *words]
    extra = {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1", **environment}
    return subprocess.run(
        command, cwd=tree, env=os.environ | extra, capture_output=True, text=True, check=False, timeout=limit_s
    )
