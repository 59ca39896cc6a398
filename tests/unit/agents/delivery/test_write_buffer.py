import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from agents.delivery.spool import Spool, SpoolConfig
from agents.delivery.write_buffer import WriteBuffer
from protocol.errors import StoreError
from protocol.machine.samples import empty
from tests.unit.agents.drives import made_up_samples

ROWS = made_up_samples(400)
BETTER = ROWS.copy()
BETTER["x_m"] += 1.0


@pytest.fixture
def spool(tmp_path: Path) -> Iterator[Spool]:
    spool = Spool(tmp_path / "spool.db", SpoolConfig())
    yield spool
    spool.close()


def sendable(spool: Spool) -> bytes:
    head = spool.head(1000)
    return head.rows.tobytes() if head else b""


def test_final_values_find_their_samples_in_memory_and_on_disk(spool: Spool) -> None:
    buffer = WriteBuffer()
    buffer.add(ROWS[:4], empty())
    assert buffer.write(spool) == 4
    assert buffer.is_clean
    buffer.add(ROWS[4:8], BETTER[:6])  # 4 of them are on disk, 2 are not
    assert (len(buffer), buffer.is_clean) == (4, False)
    assert buffer.write(spool) == 4
    assert sendable(spool) == BETTER[:6].tobytes()
    assert spool.counters()["pending"] == 2
    buffer.add(empty(), BETTER[6:8])
    assert (len(buffer), buffer.is_clean) == (0, False)
    assert buffer.write(spool) == 0
    assert sendable(spool) == BETTER[:8].tobytes()


@pytest.mark.parametrize("seed", range(4))
def test_whatever_the_disk_does_each_sample_gets_its_own_final_value(tmp_path: Path, seed: int) -> None:
    """New samples, final values, writes and full disks in any order, against a list."""
    rng, buffer = random.Random(seed), WriteBuffer()
    spool = Spool(tmp_path / "spool.db", SpoolConfig())
    made = final = 0
    for _ in range(60):
        n = rng.randint(0, min(6, len(ROWS) - made))
        k = rng.choice((0, rng.randint(0, made + n - final)))
        buffer.add(ROWS[made : made + n], BETTER[final : final + k])
        made, final = made + n, final + k
        if rng.random() < 0.5 and not buffer.is_clean:
            spool._db.execute(f"PRAGMA query_only = {rng.choice(('ON', 'OFF'))}")
            try:
                buffer.write(spool)
            except StoreError:
                assert not buffer.is_clean
                continue
            assert buffer.is_clean
            assert sendable(spool) == BETTER[:final].tobytes(), f"seed={seed}"
            assert spool.counters()["pending"] == made - final
    spool._db.execute("PRAGMA query_only = OFF")
    buffer.add(empty(), BETTER[final:made])
    buffer.write(spool)
    assert sendable(spool) == BETTER[:made].tobytes()
    assert (spool.counters()["recorded"], buffer.given_up) == (made, 0)
    spool.close()


def test_memory_gives_up_the_oldest_that_are_final_and_counts_them(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("agents.delivery.write_buffer.MOST_UNSAVED", 8)
    buffer, final = WriteBuffer(), empty()
    for i in range(20):
        final = BETTER[i - 3 : i - 2] if i >= 3 else empty()
        buffer.add(ROWS[i : i + 1], final)
    assert (len(buffer), buffer.given_up) == (8, 12)
    buffer.write(spool)
    assert sendable(spool) == BETTER[12:17].tobytes()
    buffer.add(empty(), BETTER[17:20])
    buffer.write(spool)
    assert sendable(spool) == BETTER[12:20].tobytes()
