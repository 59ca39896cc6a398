"""`python -m tests.nightly [PART ...]`: what is too slow for `make test`, in parts with budgets.

Without PART: all that have not passed yet, so an interrupted run continues; after a complete pass, and with --again,
all start anew. Failing parts stop no others. Output: .nightly/PART.log.

Exit code 0 if all requested parts passed, 1 if not, 2: wrong option, 130: interrupted.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from sitegrid.process.lifetime import raise_interrupts
from tests.paths import ROOT

FOLDER = ROOT / ".nightly"
NIGHT_S = 60 * 60.0
HANGS = 4  # budgets after which a part counts as hung
TIDY_S = 60.0  # for an interrupted part to end its processes
TESTS = ("pytest", "--quiet", "--numprocesses", "auto", "--dist", "worksteal", "--durations", "15")
COMPOSE = ("tests/integration/test_compose.py", "tests/integration/test_compose_ha.py")
FOLD = ("tests/integration/test_fold_jobs.py", "tests/unit/sitegrid/refold")
TAKEOVER = ("tests/integration/test_takeover.py",)
FOLLOWERS = ("tests/integration/test_followers.py",)
RELEASE = ("tests/release",)
SPEED = (
    "merge --runs 1 --samples 50000",
    "ingest --runs 1 --samples 5000",
    "fleet --machines 50 --seconds 10 --hours 0.5",
    "live --seconds 20 --hours 0.5",
    "query --hours 0.5 --queries 20",
    "restart --samples 200000 --hours 0.5",
    "export --hours 0.5 --runs 1",
    "walks",
    "filter --runs 1 --steps 300",
    "sim --runs 1 --seconds 5",
    "archive --samples 200000",
)
OTHERS = tuple(word for path in (*COMPOSE, *FOLD, *TAKEOVER, *FOLLOWERS, *RELEASE) for word in ("--ignore", path))


@dataclass(frozen=True)
class Part:
    """Modules to run with their words. budget_s: on two quiet cores."""

    name: str
    budget_s: float
    commands: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class PartOutcome:
    """Result of a part. commit: of the checkout, + if modified."""

    name: str
    ok: bool
    seconds: float
    commit: str


def loads(*lines: str) -> tuple[tuple[str, ...], ...]:
    """Lab loads in smoke-test sizes."""
    return tuple(("lab", "speed", *line.split()) for line in lines)


PARTS = (
    Part("tests", 400, ((*TESTS, "-m", "nightly", "tests", *OTHERS),)),
    Part("chaos", 330, (("tests.chaos", "--json", "--seconds", "240"),)),
    Part("worlds", 90, (("tests.delivery_simulation", "--seeds", "1000"), ("tests.fuzz", "--seconds", "30"))),
    Part("takeover", 180, ((*TESTS, *TAKEOVER), ("tests.takeover", "--count", "12"))),
    Part("compose", 180, ((*TESTS, *COMPOSE),)),
    Part("release", 900, ((*TESTS[:2], *RELEASE),)),
    Part("fold", 140, ((*TESTS, "-m", "nightly", *FOLD),)),
    Part("followers", 120, ((*TESTS, *FOLLOWERS), *loads("followers --machines 20 --seconds 5 --hours 0.2 --runs 1"))),
    Part("lab", 300, ((*TESTS, "lab/tests"),)),
    Part("speed", 180, loads(*SPEED)),
    Part("soak", 780, (("tests.soak",),)),
)
WEEKLY = (
    Part("soak-hour", 3700, (("tests.soak", "--minutes", "3600"),)),
    Part("takeovers", 1500, (("tests.takeover", "--count", "200"),)),
    Part("lanes", 1000, (("tests.lanes_hour",),)),
)


def main(words: Sequence[str] | None = None, parts: Sequence[Part] = (), folder: Path = FOLDER) -> int:
    """Run parts, default those of the night or week, and print a table."""
    arguments = _parse(words, parts)
    chosen = parts or (WEEKLY if arguments.weekly else PARTS)
    known = {part.name: part for part in chosen}
    done = {} if arguments.again else _read(folder)
    if all(name in done and done[name].ok for name in known):
        done = {}
    asked = [known[name] for name in arguments.parts] or [p for p in chosen if not (p.name in done and done[p.name].ok)]
    raise_interrupts()
    try:
        for part in asked:
            done.pop(part.name, None)
            print(f"{part.name}: budget {_clock(part.budget_s)}", flush=True)
            done[part.name] = _run(part, folder)
            _write(folder, done)
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from here")
        return 130
    wanted = [part.name for part in asked] if arguments.parts else list(known)
    outcomes = [done[name] for name in known if name in done]
    ok = all(done[name].ok for name in wanted)
    print(_table(outcomes, known))
    if arguments.json:
        print(json.dumps({"ok": ok, "parts": [asdict(o) | {"budget_s": known[o.name].budget_s} for o in outcomes]}))
    return 0 if ok else 1


def _parse(words: Sequence[str] | None, parts: Sequence[Part]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.nightly", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(p.name for p in parts or PARTS))
    parser.add_argument("--weekly", action="store_true", help=f"those of the week: {', '.join(p.name for p in WEEKLY)}")
    parser.add_argument("--again", action="store_true", help="begin anew, whatever has passed")
    parser.add_argument("--json", action="store_true", help="the last line is one JSON object")
    arguments = parser.parse_args(words)
    names = [part.name for part in parts or (WEEKLY if arguments.weekly else PARTS)]
    for name in arguments.parts:
        if name not in names:
            parser.error(f"no part `{name}`; there are {', '.join(names)}")
    return arguments


def _run(part: Part, folder: Path) -> PartOutcome:
    folder.mkdir(exist_ok=True)
    began_s = time.monotonic()
    with (folder / f"{part.name}.log").open("wb") as log:
        codes = [_code_of(command, log.fileno(), HANGS * part.budget_s) for command in part.commands]
    return PartOutcome(part.name, not any(codes), round(time.monotonic() - began_s, 1), _commit())


def _code_of(command: Sequence[str], log: int, limit_s: float) -> int:
    """Exit code of a module; a hung one is ended with its children."""
    line = [sys.executable, "-m", *command]
    process = subprocess.Popen(line, cwd=ROOT, stdout=log, stderr=log, stdin=subprocess.DEVNULL, start_new_session=True)
    try:
        return process.wait(limit_s)
    except subprocess.TimeoutExpired:
        os.write(log, f"ended: still at work after {limit_s:.0f} s\n".encode())
        return _end(process)
    except KeyboardInterrupt:
        _end(process)
        raise


def _end(process: subprocess.Popen[bytes]) -> int:
    """By SIGINT, which pytest and others handle with cleanup; then by force."""
    process.send_signal(signal.SIGINT)
    try:
        process.wait(TIDY_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return process.returncode or 1


def _commit() -> str:
    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()

    return git("rev-parse", "--short", "HEAD") + ("+" if git("status", "--porcelain") else "")


def _read(folder: Path) -> dict[str, PartOutcome]:
    path = folder / "state.json"
    rows = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    return {row["name"]: PartOutcome(**row) for row in rows}


def _write(folder: Path, done: dict[str, PartOutcome]) -> None:
    (folder / "state.json").write_text(json.dumps([asdict(outcome) for outcome in done.values()]), encoding="utf-8")


def _table(outcomes: Sequence[PartOutcome], known: dict[str, Part]) -> str:
    lines = [f"{'part':<10} {'':<7}{'time':>6} {'budget':>7}  commit"]
    for one in outcomes:
        times = f"{_clock(one.seconds):>6} {_clock(known[one.name].budget_s):>7}"
        over = "  over its budget" if one.seconds > known[one.name].budget_s else ""
        lines.append(f"{one.name:<10} {'ok' if one.ok else 'FAILED':<7}{times}  {one.commit}{over}")
    total = _clock(sum(one.seconds for one in outcomes)), _clock(sum(known[one.name].budget_s for one in outcomes))
    return "\n".join([*lines, f"{'all':<18}{total[0]:>6} {total[1]:>7}"])


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02}"


if __name__ == "__main__":
    sys.exit(main())
