"""Constants that are varied one by one."""

from dataclasses import asdict, fields

from agents.estimation.tuning import TUNING
from lab.ground.sensitivity import INTERVALS, moved, variants


def test_each_variant_changes_one_constant_and_whole_numbers_stay_whole():
    whole, *varied = variants()
    assert whole.tuning == TUNING
    assert len({each.name for each in varied}) == len(varied) == 2 * len(fields(TUNING))
    for each in varied:
        changed = dict(asdict(each.tuning).items() - asdict(TUNING).items())
        assert list(changed) == [each.constant]
        assert type(changed[each.constant]) is type(getattr(TUNING, each.constant))


def test_a_figure_moves_where_either_variant_leaves_its_interval():
    whole = dict.fromkeys(INTERVALS, 1.0) | {"constant": "walk"}
    less, more = whole | {"grade_std_deg": 1.0 - 2 * INTERVALS["grade_std_deg"]}, whole | {"right_class_pct": 1.01}
    row = moved(whole, less, more)
    assert (row["constant"], row["value"], row["moves"]) == ("walk", TUNING.walk, "grade_std_deg")
