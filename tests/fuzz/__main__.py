"""`python -m tests.fuzz --seconds 60`: fuzz all decoders, or one, and print the fate of the inputs.

--decoder NAME: only this one. --seed N: other inputs. Failing inputs are saved as corpus/<decoder>/<hash>. Exit code 1
if there are any.

Known failing inputs are replayed, then new ones are made until the time is up.
"""

from __future__ import annotations

import argparse
import hashlib
import logging
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis.errors import HypothesisException

from tests.fuzz.decoders import decoders
from tests.fuzz.verdict import Decoder, FaultError, judge, watched

CORPUS = Path(__file__).parent / "corpus"
MAX_FILE_BYTES = 16 * 2**10
ROUND = 200  # inputs between looks at the clock
SHRINK = 400  # attempts to shorten a failing input
LINE = "{:<14} {:>9} {:>9} {:>9} {:>7}"


@dataclass
class DecoderResult:
    """Results of one decoder. faults: by signature, description and shortest input."""

    decoder: str
    accepted: int = 0
    refused: int = 0
    faults: dict[str, tuple[str, bytes]] = field(default_factory=dict)

    def take(self, decoder: Decoder, data: bytes) -> str | None:
        """Judge one input; returns its fault's signature, if any."""
        try:
            if judge(decoder, data):
                self.accepted += 1
            else:
                self.refused += 1
        except FaultError as fault:
            shortest = self.faults.get(fault.signature)
            if shortest is None or len(data) < len(shortest[1]):
                self.faults[fault.signature] = (str(fault), data)
            return fault.signature
        return None


def replay(decoder: Decoder) -> DecoderResult:
    """Seeds must be accepted, and the corpus be free of faults."""
    result = DecoderResult(decoder.name)
    for data in decoder.seeds:
        result.take(decoder, data)
        if result.refused:
            raise AssertionError(f"{decoder.name}: a valid input is refused: {data[:80]!r}")
    for path in sorted((CORPUS / decoder.name).glob("*")):
        result.take(decoder, path.read_bytes())
    return result


def fuzz(decoder: Decoder, result: DecoderResult, n: int, number: int) -> None:
    """Judge about `n` inputs from the seed `number`; stops at the first new fault, and shortens its input."""
    known, first, tries = set(result.faults), "", 0

    @seed(number)
    @settings(
        max_examples=n,
        deadline=None,
        database=None,
        derandomize=False,
        print_blob=False,
        report_multiple_bugs=False,
        phases=(Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
    )
    @given(data=decoder.inputs(decoder.seeds))
    def one(data: bytes) -> None:
        nonlocal first, tries
        signature = result.take(decoder, data)
        tries += bool(first)
        if signature and signature not in known and signature == (first or signature) and tries < SHRINK:
            first = signature
            raise FaultError(signature, "again")

    try:
        one()
    except (FaultError, HypothesisException):  # interrupted shrinking counts as flaky for Hypothesis
        assert first, "Hypothesis failed by itself"


def fuzz_for(decoder: Decoder, seconds: float, number: int) -> DecoderResult:
    """Replay, then fuzz until the time is up."""
    result, end_s, rounds = replay(decoder), time.monotonic() + seconds, 0
    while time.monotonic() < end_s:
        fuzz(decoder, result, ROUND, 1_000_003 * number + rounds)
        rounds += 1
    return result


def save(result: DecoderResult) -> list[Path]:
    """Add failures to the corpus; returns new files."""
    saved = []
    for _, data in result.faults.values():
        path = CORPUS / result.decoder / hashlib.sha256(data).hexdigest()[:12]
        if len(data) <= MAX_FILE_BYTES and not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            saved.append(path)
    return saved


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="for all decoders together")
    parser.add_argument("--decoder", help="only this one")
    parser.add_argument("--seed", type=int, default=0, help="other inputs")
    arguments = parser.parse_args()
    logging.disable()  # decoders log bad files
    chosen = [one for one in decoders() if arguments.decoder in (None, one.name)]
    if not chosen:
        parser.error(f"no decoder {arguments.decoder!r}; there are {', '.join(one.name for one in decoders())}")
    print(LINE.format("decoder", "examples", "accepted", "refused", "faults"))
    results = []
    with watched():
        for decoder in chosen:
            results.append(fuzz_for(decoder, arguments.seconds / len(chosen), arguments.seed))
            _show(results[-1])
    return 1 if any(result.faults for result in results) else 0


def _show(result: DecoderResult) -> None:
    counts = (result.accepted, result.refused, len(result.faults))
    print(LINE.format(result.decoder, result.accepted + result.refused, *counts))
    for problem, _ in result.faults.values():
        print(f"  {problem}")
    for path in save(result):
        print(f"  saved {path.name}")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
