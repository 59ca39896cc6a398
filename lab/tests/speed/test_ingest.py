import json

import pytest

from lab.speed.__main__ import BENCHMARKS, OPTIONS, main

COLUMNS = ["journal", "batch", "batches_per_commit", "samples_per_s", "samples_per_cpu_s", "ms_per_commit", "of_sqlite"]


@pytest.mark.slow
def test_ingest_prints_one_json_object(capsys):
    assert main(["ingest", "--json", "--samples", "250", "--runs", "1"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["benchmark"], result["samples"]) == ("ingest", 250)
    journals = ("sqlite", "postgres", "postgres, synchronous replica")
    assert [(row["batch"], row["batches_per_commit"], row["journal"]) for row in result["rows"]] == [
        (size, group, journal) for size in (6, 100, 1000) for group in (1, 16) for journal in journals
    ]
    assert all(list(row) == COLUMNS for row in result["rows"])
    assert all(row[name] > 0 for row in result["rows"] for name in COLUMNS[1:])
    assert all(row["of_sqlite"] == 1.0 for row in result["rows"] if row["journal"] == "sqlite")


def test_without_a_database_that_is_said_and_a_table_of_the_others_is_printed(capsys, monkeypatch):
    def nothing() -> None:
        raise RuntimeError("apt-get install postgresql")

    monkeypatch.setattr("tests.postgres_server.binaries", nothing)
    main(["ingest", "--samples", "100", "--runs", "1"])
    shown = capsys.readouterr()
    assert shown.err == "not measured: postgres; apt-get install postgresql\n"
    lines = shown.out.splitlines()
    assert lines[0].split() == COLUMNS
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
