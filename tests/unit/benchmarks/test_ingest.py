import json

import pytest

from benchmarks.__main__ import main


def test_ingest_prints_one_json_object(capsys):
    assert main(["ingest", "--json", "--samples", "250", "--runs", "1"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["benchmark"], result["samples"]) == ("ingest", 250)
    assert all(set(row) == {"batch", "batches_per_commit", "samples_per_s", "ms_per_commit"} for row in result["rows"])
    assert all(value > 0 for row in result["rows"] for value in row.values())


def test_without_json_a_table_is_printed(capsys):
    main(["ingest", "--samples", "100", "--runs", "1"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["batch", "batches_per_commit", "samples_per_s", "ms_per_commit"]
    assert len(lines) == 5
    assert len({len(line) for line in lines}) == 1


@pytest.mark.parametrize(
    "words",
    [
        ["merge", "--samples", "-1"],
        ["merge", "--runs", "0"],
        ["merge", "--hours", "1"],
        ["memory", "--hours", "0"],
        ["memory", "--hours", "inf"],
        ["memory", "--samples", "100"],
        ["memory", "--runs", "1"],
        ["restart", "--samples", "0"],
        ["restart", "--runs", "1"],
        ["restart", "--hours", "1"],
        ["query"],
        [],
    ],
)
def test_wrong_usage_ends_with_two(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "usage" in capsys.readouterr().err
