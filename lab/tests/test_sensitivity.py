from dataclasses import asdict, fields

import pytest

from lab.sensitivity import STAGES, VariedGround, VariedPositions, moved, variants, varied


@pytest.mark.parametrize("stage", STAGES)
def test_each_variant_changes_one_constant_and_whole_numbers_stay_whole(stage: str):
    tuning = STAGES[stage].tuning
    for variant in variants(tuning):
        changed = dict(asdict(varied(tuning, variant)).items() - asdict(tuning).items())
        assert list(changed) == [variant[0]]
        assert type(changed[variant[0]]) is type(getattr(tuning, variant[0]))
    assert len(variants(tuning)) == 2 * len(fields(tuning))


def test_rows_of_variants_have_names_of_their_own_and_their_tuning():
    rows = [VariedGround("kalman", "calibrated", variant=(name, 0.7)) for name in ("walk", "noise")]
    assert len({row.name for row in rows}) == 2
    assert rows[0].tuning.walk == 0.7 * STAGES["estimation"].tuning.walk
    row = VariedPositions("ukf", 2, 1, "default", variant=("relock", 0.7))
    assert row.tuning.relock == 10


def test_a_figure_moves_where_either_variant_leaves_its_interval():
    stage = STAGES["estimation"]
    whole = dict.fromkeys(stage.intervals, 1.0)
    less, more = (
        whole | {"grade_std_deg": 1.0 - 2 * stage.intervals["grade_std_deg"]},
        whole | {"right_class_pct": 1.01},
    )
    row = moved(stage, "walk", whole, (less, more))
    assert (row["constant"], row["value"], row["moves"]) == ("walk", stage.tuning.walk, "grade_std_deg")
