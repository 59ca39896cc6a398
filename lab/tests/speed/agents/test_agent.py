import pytest

from lab.speed.measure import in_child


@pytest.mark.slow
def test_an_agent_keeps_to_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """A BLAS that splits small matrices among the cores spins: thirty times the processor time, for the same bits."""
    cpu_percent = []
    for threads in ("1", "2"):
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", threads)
        cpu_percent.append(in_child("lab.speed.agents.agent", "20")["cpu_percent"])
    alone, may_split = cpu_percent
    assert may_split < 3 * alone
