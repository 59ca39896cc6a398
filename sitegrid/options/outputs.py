"""Types of options that name what a command writes: refused before the work, not after it.

That a file can be made there is tried, with one that has no name: permissions do not tell (root, read-only mounts).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile

from protocol.errors import ConfigError


@dataclass(frozen=True)
class OutputFile:
    """A file to write. suffixes: of its formats, none for any name. makes_folder: its folder need not be there."""

    suffixes: tuple[str, ...] = ()
    makes_folder: bool = False

    def __call__(self, text: str) -> Path:
        """Parse the option; ConfigError where nothing could be written."""
        path = Path(text)
        if self.suffixes and path.suffix.lower() not in self.suffixes:
            fitting = path.with_suffix(self.suffixes[0]) if path.name else Path(f"NAME{self.suffixes[0]}")
            raise ConfigError(path, f"a file with {' or '.join(self.suffixes)} is written: name it {fitting}")
        if path.is_dir():
            raise ConfigError(path, "is a folder; name a file")
        if not self.makes_folder and not path.parent.is_dir():
            raise ConfigError(path, f"cannot be written: there is no folder {path.parent}")
        _require_writable(path.parent, path)
        return path


@dataclass(frozen=True)
class OutputFolder:
    """A folder to write into, made where it is missing."""

    def __call__(self, text: str) -> Path:
        """Parse the option; ConfigError where nothing could be written."""
        path = Path(text)
        _require_writable(path, path)
        return path


PICTURE = OutputFile((".png", ".jpg", ".jpeg"))
FOLDER = OutputFolder()


def _require_writable(folder: Path, path: Path) -> None:
    """Refuse a path where the folder, or the next one above it that is there, takes no file."""
    there = folder.absolute()
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise ConfigError(path, f"cannot be written: {there} is no folder")
    try:
        TemporaryFile(dir=there).close()
    except OSError as error:
        raise ConfigError(path, f"cannot be written: {there}: {error.strerror}; choose another place") from None
