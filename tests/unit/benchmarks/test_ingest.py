import json

import pytest

from benchmarks.__main__ import BENCHMARKS, OPTIONS, main


def test_ingest_prints_one_json_object(capsys):
    assert main(["ingest", "--json", "--samples", "250", "--runs", "1"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["benchmark"], result["samples"]) == ("ingest", 250)
    assert [(row["batch"], row["batches_per_commit"]) for row in result["rows"]] == [
        (size, group) for size in (6, 100, 1000) for group in (1, 16)
    ]
    names = {"batch", "batches_per_commit", "samples_per_s", "samples_per_cpu_s", "ms_per_commit"}
    assert all(set(row) == names for row in result["rows"])
    assert all(value > 0 for row in result["rows"] for value in row.values())


def test_without_json_a_table_is_printed(capsys):
    main(["ingest", "--samples", "100", "--runs", "1"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["batch", "batches_per_commit", "samples_per_s", "samples_per_cpu_s", "ms_per_commit"]
    assert len(lines) == 7
    assert len({len(line) for line in lines}) == 1


@pytest.mark.parametrize("name", BENCHMARKS)
def test_an_option_that_does_nothing_or_makes_no_sense_is_refused(name, capsys):
    taken = BENCHMARKS[name][2]
    wrong = [(option, "5") for option in OPTIONS.keys() - taken.keys()]
    wrong += [(option, value) for option in taken for value in ("0", "-1", "nan", "inf")]
    for words in ([], ["nothing"], *([name, f"--{option}", value] for option, value in wrong)):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 2, words
        assert "usage" in capsys.readouterr().err
