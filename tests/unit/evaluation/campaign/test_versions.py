from pathlib import Path

import pytest

from evaluation.campaign import versions


def test_the_version_of_code_changes_with_each_source_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(versions, "ROOT", tmp_path)
    (tmp_path / "package").mkdir()
    seen = set()
    for i, name in enumerate(("a.py", "a.py", "package/b.toml", "package/c.urdf")):
        (tmp_path / name).write_text(f"x = {i}")
        seen.add(versions.code_version.__wrapped__("a.py", "package"))
    (tmp_path / "package" / "notes.md").write_text("not a source")
    assert len(seen | {versions.code_version.__wrapped__("a.py", "package")}) == 4


def test_a_source_that_is_not_there_is_an_error():
    with pytest.raises(FileNotFoundError, match="nowhere"):
        versions.code_version("protocol/units.py", "nowhere.py")


def test_a_digest_tells_where_one_text_ends():
    assert versions.digest("ab", "c") != versions.digest("a", "bc")
    assert len(versions.digest("a")) == 10
