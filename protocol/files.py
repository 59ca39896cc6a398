"""Files: TOML with errors for people, and atomic writes."""

import fcntl
import os
import secrets
import tomllib
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO

from protocol.errors import ConfigError

PRIVATE = 0o600  # what a site's machines sent is private on a shared host


def load_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; errors name file and line."""
    return _parse_toml(path, _read_text(path))


def sealed(text: str) -> str:
    """A text behind its checksum line, against flipped bits in files that programs write."""
    return f"{_seal(text)}\n{text}"


def load_sealed_toml(path: Path) -> dict[str, Any]:
    """As `load_toml`, of a `sealed` file; ConfigError if its checksum differs."""
    first, _, text = _read_text(path).partition("\n")
    if first != _seal(text):
        problem = "is damaged, or was changed by hand; restore it from a backup, or make it anew with `sitegrid keys`"
        raise ConfigError(path, problem)
    return _parse_toml(path, text)


def _seal(text: str) -> str:
    return f"# checksum {zlib.crc32(text.encode()):08x}"


def _read_text(path: Path) -> str:
    try:
        return path.read_bytes().decode()
    except FileNotFoundError:
        raise ConfigError(path, "no such file") from None
    except OSError as error:
        raise ConfigError(path, f"cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(path, f"not valid TOML: {error}") from None


def _parse_toml(path: Path, text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also of very long numbers and deep lists
        raise ConfigError(path, f"not valid TOML: {error}") from None


@contextmanager
def whole_file(path: Path, permissions: int = 0o666) -> Iterator[BinaryIO]:
    """Open a binary file that replaces `path` when the block ends without an error; OSError.

    Readers see the old file or the new one, also after a power cut. Each writer locks its own `.NAME.*.part`; the next
    one removes unlocked leftovers of killed writers. permissions: of the new file, before the umask.
    """
    for left in path.parent.glob(f".{path.name}.*.part"):
        _remove_if_left(left)
    part, file = _open_locked(path, permissions)
    try:
        with file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    sync_folder(path.parent)


def write_whole(path: Path, data: bytes, permissions: int = 0o666) -> None:
    """Write a file atomically; OSError."""
    with whole_file(path, permissions) as file:
        file.write(data)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Make a folder that appears when the block ends without an error; OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{path.name}.", suffix=".part", dir=path.parent) as beside:
        part = Path(beside) / path.name
        part.mkdir()
        yield part
        sync_folder(part)
        part.rename(path)
    sync_folder(path.parent)


def make_private(path: Path) -> None:
    """Create a missing file readable only by its owner, whatever the umask; OSError."""
    os.close(os.open(path, os.O_RDWR | os.O_CREAT, PRIVATE))


def sync_folder(folder: Path) -> None:
    """Make a folder's names durable; OSError."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _open_locked(path: Path, permissions: int) -> tuple[Path, BinaryIO]:
    """Create a file beside `path`; retry if another writer removed it before the lock."""
    while True:
        part = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")
        file = open(part, "x+b", opener=lambda name, flags: os.open(name, flags, permissions))  # noqa: SIM115
        fcntl.flock(file, fcntl.LOCK_EX)
        if part.exists():
            return part, file
        file.close()


def _remove_if_left(part: Path) -> None:
    try:
        with part.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            part.unlink(missing_ok=True)
    except (FileNotFoundError, BlockingIOError):  # finished meanwhile, or being written
        return
