import json

import pytest

from benchmarks.__main__ import main

COLUMNS = {
    "merge": {"variant", "pattern", "msamples_per_s", "us_per_batch_of_100"},
    "ingest": {"batch", "batches_per_commit", "samples_per_s", "ms_per_commit"},
}


@pytest.mark.parametrize("name", ["merge", "ingest"])
def test_a_benchmark_prints_one_json_object(name, capsys):
    assert main([name, "--json", "--samples", "250", "--runs", "1"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["benchmark"], result["samples"]) == (name, 250)
    assert all(set(row) == COLUMNS[name] for row in result["rows"])
    assert all(value > 0 for row in result["rows"] for value in row.values() if not isinstance(value, str))


def test_merge_measures_every_variant_on_every_pattern(capsys):
    main(["merge", "--json", "--samples", "100", "--runs", "1"])
    rows = json.loads(capsys.readouterr().out)["rows"]
    variants = ("soft_votes numba", "soft_votes numpy", "np.add.at three sums")
    assert [(row["pattern"], row["variant"]) for row in rows] == [(p, v) for p in ("track", "random") for v in variants]


def test_without_json_a_table_is_printed(capsys):
    main(["ingest", "--samples", "100", "--runs", "1"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["batch", "batches_per_commit", "samples_per_s", "ms_per_commit"]
    assert len(lines) == 5
    assert len({len(line) for line in lines}) == 1


@pytest.mark.parametrize("words", [["merge", "--samples", "-1"], ["merge", "--runs", "0"], ["query"], []])
def test_wrong_usage_ends_with_two(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "usage" in capsys.readouterr().err
