"""Recordings: readings return bit for bit despite interruption or damage; validators accept them."""

from __future__ import annotations

import json
import random
from pathlib import Path

import jsonschema
import pytest
from mcap.reader import make_reader

from protocol.errors import ConfigError
from protocol.machine.readings import KINDS, MAX_STAMP_NS, Reading, parse_reading
from protocol.machine.recorded_readings import RecordedReading, readings_of, record_reading
from protocol.recording import FLUSH_S, RecordedFile, Recording

SEED = 7


def readings(count: int) -> list[RecordedReading]:
    """All kinds of readings, any bits of doubles within limits, stamps in any order."""
    draw = random.Random(SEED)
    return [
        RecordedReading(f"loader-{i % 3}", 10**18 + i, reading_of(draw, [*KINDS][i % len(KINDS)])) for i in range(count)
    ]


def reading_of(draw: random.Random, kind: str) -> Reading:
    def value(low: float, high: float) -> float:
        return draw.choice(
            (
                float(low),
                float(high),
                draw.uniform(low, high),
                *(tiny for tiny in (-0.0, 5e-324) if low <= tiny <= high),
            )
        )

    values = tuple(value(*limits) for limits in KINDS[kind].limits.values())
    return parse_reading(kind, f"{kind}-1", draw.randint(1, MAX_STAMP_NS), values)


def written(path: Path, taken: list[RecordedReading]) -> Recording:
    recording = Recording(path, {"site": "paper"})
    for machine, log_ns, reading in taken:
        record_reading(recording, machine, log_ns, reading)
    return recording


def exact(taken: list[RecordedReading]) -> list[str]:
    """With the sign of zero, unlike equality."""
    return list(map(repr, taken))


def test_readings_come_back_bit_for_bit_and_in_their_order(tmp_path: Path):
    taken = readings(500)
    written(tmp_path / "a.mcap", taken).finish()
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
    file = RecordedFile(tmp_path / "a.mcap")
    assert exact(list(readings_of(file))) == exact(taken)
    assert not file.is_cut


def test_a_validator_reads_it_and_each_message_has_its_schema(tmp_path: Path):
    written(tmp_path / "a.mcap", readings(100)).finish()
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        read = [(json.loads(schema.data), json.loads(message.data)) for schema, _, message in reader.iter_messages()]
        summary = reader.get_summary()
    assert summary.statistics.message_count == len(read) == 100
    for schema, message in read:
        jsonschema.validate(message, schema | {"required": [*schema["properties"]], "additionalProperties": False})


def test_wherever_it_is_cut_all_that_was_flushed_is_read(tmp_path: Path):
    now_s, taken = [0.0], readings(60)
    recording = Recording(tmp_path / "a.mcap", {}, lambda: now_s[0])
    for i, (machine, log_ns, reading) in enumerate(taken):
        record_reading(recording, machine, log_ns, reading)
        now_s[0] += FLUSH_S / 20
        recording.tend()
        if i == 40:
            killed = recording.part.read_bytes()
    recording.finish()
    for data, least in ((killed, 40), (recording.path.read_bytes(), 0)):
        for size in (*random.Random(SEED).sample(range(60, len(data)), 40), len(data) - 1):
            (tmp_path / "cut").write_bytes(data[:size])
            file = RecordedFile(tmp_path / "cut")
            read = list(readings_of(file))
            assert file.is_cut
            assert exact(read) == exact(taken[: len(read)])
        assert len(read) >= least


def test_damage_is_one_line_and_never_another_reading(tmp_path: Path):
    taken, draw = readings(60), random.Random(SEED)
    written(tmp_path / "a.mcap", taken).finish()
    whole = (tmp_path / "a.mcap").read_bytes()
    for _ in range(100):
        data = bytearray(whole)
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        (tmp_path / "b.mcap").write_bytes(data)
        read, problem = until_damage(tmp_path / "b.mcap")
        assert problem == "" or problem.startswith(f"{tmp_path}/b.mcap: ")
        assert exact(read) == exact(taken[: len(read)])


def until_damage(path: Path) -> tuple[list[RecordedReading], str]:
    read: list[RecordedReading] = []
    try:
        read.extend(readings_of(path))
    except ConfigError as error:
        return read, str(error)
    return read, ""


@pytest.mark.parametrize("data", [b"", b"\x89MCAP", b"no recording at all, but a text"])
def test_what_is_no_recording_is_refused(data: bytes, tmp_path: Path):
    (tmp_path / "a.mcap").write_bytes(data)
    with pytest.raises(ConfigError, match="no MCAP file, or damaged"):
        list(readings_of(tmp_path / "a.mcap"))


def test_an_interrupted_recording_is_never_written_over(tmp_path: Path):
    written(tmp_path / "a.mcap", readings(3)).abandon()
    with pytest.raises(ConfigError, match=r"a\.mcap\.part: an interrupted recording"):
        Recording(tmp_path / "a.mcap", {})
