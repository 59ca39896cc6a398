import subprocess
from pathlib import Path

import pytest

from lab.campaign.provenance import commit_of, made_by


@pytest.mark.parametrize(
    ("words", "command"),
    [
        ("paper --seeds 12 --out /tmp/x --json", "python -m lab paper --seeds 12 --json"),
        ("paper --out=/tmp/x --processes 2 --plots y", "python -m lab paper"),
        ("bench score /home/me/entry --quick --data z", "python -m lab bench score entry --quick"),
    ],
)
def test_a_command_lasts_without_the_places_of_one_computer(words: str, command: str):
    assert made_by(words.split())["command"] == command


def git(folder: Path, *words: str) -> str:
    named = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    return subprocess.run(["git", "-C", folder, *named, *words], check=True, capture_output=True, text=True).stdout


def test_the_commit_says_where_files_are_others(tmp_path: Path):
    git(tmp_path, "init")
    (tmp_path / "a.py").write_text("1")
    git(tmp_path, "add", "a.py")
    git(tmp_path, "commit", "-m", "a")
    commit = git(tmp_path, "rev-parse", "--short=8", "HEAD").strip()
    assert commit_of(tmp_path) == commit
    (tmp_path / "a.py").write_text("2")
    assert commit_of(tmp_path) == f"{commit}-dirty"
