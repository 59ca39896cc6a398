"""A short, repeatable `python -m tests.fuzz`: the corpus, then a few inputs per decoder."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.fuzz import verdict
from tests.fuzz.__main__ import CORPUS, DecoderResult, fuzz, replay
from tests.fuzz.decoders import decoders
from tests.fuzz.mutations import files
from tests.fuzz.verdict import Decoder, FaultError, judge, watched

NAMES = [decoder.name for decoder in decoders()]
INPUTS = 3


@pytest.fixture(scope="module", autouse=True)
def _watched() -> Iterator[None]:
    with watched():
        yield


@pytest.mark.parametrize("decoder", decoders(), ids=NAMES)
def test_an_input_is_read_or_refused_by_name(decoder: Decoder):
    result = replay(decoder)
    fuzz(decoder, result, INPUTS, 0)
    assert not result.faults, [problem for problem, _ in result.faults.values()]


def test_every_saved_input_belongs_to_a_decoder():
    assert {path.name for path in CORPUS.iterdir()} <= set(NAMES)


def crash(data: bytes) -> None:
    raise KeyError(data)


def two_lines(data: bytes) -> None:
    raise ValueError("a\nb")


def hang(data: bytes) -> None:
    while True:
        pass


def fill(data: bytes) -> None:
    bytearray(200 * 2**20)


@pytest.mark.parametrize(
    ("decode", "signature"),
    [
        (crash, "KeyError in crash"),
        (two_lines, "no plain line in ValueError"),
        (hang, "hang"),
        (fill, "memory"),
    ],
)
def test_a_planted_fault_is_found(decode, signature: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(verdict, "CPU_S", 0.2)
    planted = Decoder("planted", (b"x",), decode, (ValueError,), files)
    with pytest.raises(FaultError) as caught:
        judge(planted, b"x")
    assert caught.value.signature == signature


def test_a_failing_input_is_made_shorter():
    def decode(data: bytes) -> None:
        if b"\xff" in data:
            raise KeyError

    planted, result = Decoder("planted", (b"seed" * 20,), decode, (ValueError,), files), DecoderResult("planted")
    fuzz(planted, result, 500, 1)
    ((_, data),) = result.faults.values()
    assert len(data) < 80
