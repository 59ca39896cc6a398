"""`python -m tests.fuzz.can_frames --cases 1000000`: arbitrary CAN frames.

Identifiers of known groups from any sender, of other groups, with 11 bits; any bytes, cut, with error values. Nothing
may raise, every value must suit its reading, and a valid frame after every tenth is read.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from dataclasses import dataclass

from agents.drivers.can.config import SignalConfig, all_signals
from agents.drivers.can.line import CanLine
from agents.drivers.can.pgns import SIGNALS
from agents.drivers.can.signals import EXTENDED
from agents.drivers.can.streams import STREAMS
from protocol.errors import MessageError
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import parse_reading

STD = {"gps": {"position": 1.0}, "gps_velocity": {"velocity": 0.1}}
GROUPS = sorted({signal.group - EXTENDED for signal in SIGNALS.values()})
WHOLE = 3 << 26 | 61444 << 8 | 0x77, bytes((0xF0, 0xFF, 0x9D, 0xE0, 0x2E, 0xFF, 0xFF, 0xFF))
OWN = {
    "joint": SignalConfig(id=0x124, start=3, bits=13, scale=1e-3, signed=True),
    "load": SignalConfig(pgn=65_300, start=60, bits=64),
}


@dataclass
class Outcome:
    """Fate of the frames. refused: values unsuited for readings. lost: valid frames not read."""

    cases: int
    values: int
    refused: int
    lost: int
    us: float


def frame(draw: random.Random) -> tuple[int, bytes, bool]:
    """Identifier, data, and whether it has 29 bits."""
    data = bytearray(draw.randbytes(draw.choice((8, 8, 8, 8, 0, 1, 7, 64))))
    for _ in range(draw.randrange(4)):
        if data:
            data[draw.randrange(len(data))] = draw.choice((0xFA, 0xFB, 0xFE, 0xFF, 0x7F, 0x80, 0))
    if draw.random() < 0.7:
        return (
            draw.randrange(8) << 26 | draw.choice(GROUPS) << 8 | draw.choice((0, 0, 0x77, draw.randrange(256))),
            bytes(data),
            True,
        )
    is_extended = draw.random() < 0.5
    return draw.getrandbits(29 if is_extended else 11), bytes(data), is_extended


def run(cases: int, seed: int = 0) -> Outcome:
    draw = random.Random(f"can {seed}")
    feeds = {name: SensorConfig(name, s.kind, std=STD.get(s.kind, {})) for name, s in STREAMS.items()}
    feeds |= {"0x77:engine": SensorConfig("whole", "engine")}
    feeds |= {"joint": SensorConfig("joint", "articulation"), "load": SensorConfig("load", "payload")}
    line = CanLine(feeds, all_signals(OWN, ""))
    outcome, used_s = Outcome(cases, 0, 0, 0, 0.0), 0.0
    for i in range(cases):
        identifier, data, is_extended = frame(draw)
        host_ns = (i + 1) * 10**6 + draw.choice((0, 0, 0, -(10**7)))
        began_s = time.process_time()
        values = line.take(identifier, data, host_ns, is_extended=is_extended)
        used_s += time.process_time() - began_s
        for value in values:
            outcome.values += 1
            try:
                parse_reading(value.kind, value.sensor, 10**18, value.values)
            except MessageError:
                outcome.refused += 1
        if i % 10 == 9:
            taken = line.take(*WHOLE, host_ns)
            outcome.lost += not any(value.sensor == "whole" and abs(value.values[0] - 0.32) < 1e-9 for value in taken)
        if i % 1000 == 0:
            line.problems(host_ns)
    outcome.us = used_s / cases * 1e6
    return outcome


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.can_frames", description=__doc__)
    parser.add_argument("--cases", type=int, default=10_000, help="frames")
    parser.add_argument("--seed", type=int, default=0, help="other frames")
    arguments = parser.parse_args()
    outcome = run(arguments.cases, arguments.seed)
    print(outcome)
    return 1 if outcome.lost else 0


if __name__ == "__main__":
    sys.exit(main())
