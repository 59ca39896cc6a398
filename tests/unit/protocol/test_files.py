"""Files are whole or absent."""

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from protocol.files import whole_file, write_whole

KILLED = """
import os, signal, sys
from pathlib import Path
from protocol.files import whole_file
with whole_file(Path(sys.argv[1])) as file:
    file.write(b"half")
    file.flush()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_file_is_replaced_by_the_new_one(tmp_path: Path):
    path = tmp_path / "a.bin"
    write_whole(path, b"old")
    write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_while_writing_leaves_the_old_file_alone(tmp_path: Path):
    path = tmp_path / "a.bin"
    write_whole(path, b"old")

    def fail_half_way() -> None:
        with whole_file(path) as file:
            file.write(b"half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_killed_writer_leaves_the_old_file_and_the_next_one_tidies_up(tmp_path: Path):
    path = tmp_path / "a.bin"
    write_whole(path, b"old")
    assert subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False).returncode == -9
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 2
    write_whole(path, b"new")
    assert list(tmp_path.iterdir()) == [path]


def test_writers_of_one_file_do_not_meet(tmp_path: Path):
    path = tmp_path / "a.bin"

    def write(letter: bytes) -> None:
        for _ in range(50):
            write_whole(path, letter * 10_000)

    threads = [threading.Thread(target=write, args=(letter,)) for letter in (b"a", b"b")]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        if path.exists():
            read = path.read_bytes()
            assert read in (b"a" * 10_000, b"b" * 10_000)
    assert list(tmp_path.iterdir()) == [path]


def test_permissions_are_those_asked_for(tmp_path: Path):
    write_whole(tmp_path / "key", b"secret", permissions=0o600)
    assert (tmp_path / "key").stat().st_mode & 0o777 == 0o600
