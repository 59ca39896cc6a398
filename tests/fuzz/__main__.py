"""`python -m tests.fuzz --seconds 60`: fuzz all decoders, or one, and print what became of the inputs.

--decoder NAME: only this one. --seed N: other inputs. Failing inputs are saved beside the tests, in corpus/. Exit
code 1 if there are any.
"""

from __future__ import annotations

import argparse
import logging
import sys

from tests.fuzz.campaign import DecoderResult, fuzz_for, save
from tests.fuzz.decoders import decoders
from tests.fuzz.verdict import watched

LINE = "{:<14} {:>9} {:>9} {:>9} {:>7}"


def main() -> int:
    """Run."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="for all decoders together")
    parser.add_argument("--decoder", help="only this one")
    parser.add_argument("--seed", type=int, default=0, help="other inputs")
    arguments = parser.parse_args()
    logging.disable()  # what decoders log of bad files
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
