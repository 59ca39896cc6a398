"""Files in any store that fsspec reaches, by addresses such as `s3://bucket/folder`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatch
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

from protocol.errors import ConfigError, StoreError


@dataclass(frozen=True, order=True)
class FilePlace:
    """A remote file or folder; methods as of `pathlib.Path`.

    StoreError if its store is unreachable, FileNotFoundError for a missing file.
    """

    url: str

    @property
    def name(self) -> str:
        """The last part of the address."""
        return self.url.rpartition("/")[2]

    @property
    def stem(self) -> str:
        """The name without suffix."""
        return self.name.rpartition(".")[0] or self.name

    @property
    def parent(self) -> FilePlace:
        """The parent folder."""
        return FilePlace(self.url.rpartition("/")[0])

    def __truediv__(self, name: str) -> FilePlace:
        return FilePlace(f"{self.url}/{name}")

    def __str__(self) -> str:
        return self.url

    def exists(self) -> bool:
        """Whether it exists."""
        with self._reached() as store:
            return bool(store.exists(self.url))

    def is_dir(self) -> bool:
        """Whether it is a folder."""
        with self._reached() as store:
            return bool(store.isdir(self.url))

    def glob(self, pattern: str) -> list[FilePlace]:
        """Files in a folder with matching names."""
        with self._reached() as store:
            names = (str(path).rstrip("/").rpartition("/")[2] for path in store.ls(self.url, detail=False))
            return [self / name for name in names if fnmatch(name, pattern)]

    def open(self, mode: str) -> BinaryIO:
        """Open for reading."""
        with self._reached() as store:
            file: BinaryIO = store.open(self.url, mode)
            return file

    def read_text(self, encoding: str) -> str:
        """The whole file."""
        with self._reached() as store:
            return bytes(store.cat_file(self.url)).decode(encoding)

    @contextmanager
    def _reached(self) -> Iterator[Any]:
        """The file's store; any errors become one kind."""
        try:
            yield filesystem(self.url)
        except (FileNotFoundError, UnicodeDecodeError, ConfigError):
            raise
        except Exception as error:
            raise StoreError(self.url, f"cannot be read: {error or type(error).__name__}") from None


def place(text: str) -> Path | FilePlace:
    """Parse a local path or a remote address; ConfigError if no library reaches it."""
    if "://" not in text:
        return Path(text)
    filesystem(text)
    return FilePlace(text.rstrip("/"))


def filesystem(url: str) -> Any:
    """The fsspec store of an address."""
    try:
        fsspec = import_module("fsspec")
    except ModuleNotFoundError:
        raise ConfigError(url, "fsspec is not installed: pip install '.[cluster]'") from None
    kind = url.partition("://")[0]
    try:
        return fsspec.url_to_fs(url)[0]
    except ImportError as error:  # fsspec knows what each store needs
        raise ConfigError(url, f"is reached with a library that is not installed: {error}") from None
    except ValueError:
        raise ConfigError(
            url, f"no store is known as {kind!r}; {', '.join(('s3', 'gs', 'abfs', 'file'))} are"
        ) from None
