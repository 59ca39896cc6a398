"""The paper's figures: what is repeated is what it prints, and where it contradicts itself is known."""

import pytest

from lab.positions.published import PLOTTING, POSITIONS, Published


def test_two_rows_of_the_paper_do_not_fit_together():
    rows = {**POSITIONS, **{(*group, "plotting"): row for group, row in PLOTTING.items()}}
    assert [group for group, row in rows.items() if not row.is_consistent] == [
        ("ukf", 1, 3),
        ("ekf", 1, 1, "plotting"),
    ]
    assert PLOTTING["ekf", 1, 1].net_of_parts_m == pytest.approx(4.276, abs=5e-4)


def test_a_row_is_consistent_as_far_as_it_is_printed():
    assert Published(3.0, 4.0, 5.0).is_consistent
    assert Published(3.0005, 4.0005, 5.0).is_consistent
    assert not Published(3.0, 4.0, 5.01).is_consistent
