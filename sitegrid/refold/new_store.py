"""The new store of a fold, made beside its place; a killed fold's results are reused."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mapserver.config import ServerConfig
from mapserver.evidence.grid_state import GridState
from mapserver.ingest.decisions import GroundDecision, ground_decisions, plain
from mapserver.ingest.store import Store
from mapserver.ingest.store_folder import hold_place
from mapserver.journal.archive import FOLDER, file_name
from mapserver.journal.facts import Facts
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import SpoolKey, Watermark
from mapserver.past.checkpoint_file import OPEN_END_NS
from mapserver.past.checkpoints import save_snapshot
from mapserver.past.past import StorePast
from protocol.errors import ConfigError, SitegridError, StoreError
from protocol.files import sync_folder, write_whole
from protocol.site.site_config import SiteConfig
from sitegrid.refold.work import STORE_FILE, PartWork

WORK = "work"  # subfolder while in the making: see work.py


@dataclass(frozen=True)
class NewStore:
    """A store in the making. id: its own; rows: last archive row."""

    folder: Path
    id: str
    site: SiteConfig
    rows: int

    @property
    def work(self) -> Path:
        """Folder for tasks' files."""
        return self.folder / WORK

    def take_samples(self, files: Iterable[tuple[PartWork, Path]]) -> None:
        """Move each part's samples into the archive."""
        archive = self.folder / FOLDER
        archive.mkdir(exist_ok=True)
        for part, path in files:
            path.rename(archive / file_name(part.first_ns, part.row, part.row + part.rows - 1))
        sync_folder(archive)

    def save_map(self, state: GridState, config: ServerConfig, facts: Facts) -> None:
        """Write the first snapshot."""
        with JournalLocation(self.folder).reader() as journal:
            depends_on = StorePast.of_store(self.folder, self.site.cell_m, config.fold).depends_on(journal, facts)
        save_snapshot(self.folder, self.rows, depends_on(OPEN_END_NS), state)

    def fill_journal(self, watermarks: Mapping[SpoolKey, Watermark], decisions: Sequence[GroundDecision]) -> None:
        """Continue the journal after the archive, with the decisions about its samples."""
        with closing(JournalLocation(self.folder).open_file(self.site.name, self.site.frame)) as journal:
            if not journal.last_row:
                journal.follow_archive(self.rows, watermarks)
            if not journal.events():
                journal.append_events(map(plain, decisions))
            known = (journal.last_row, journal.watermarks(), ground_decisions(journal))
            if known != (self.rows, watermarks, list(decisions)):
                raise _of_another(self.folder)

    def finish(self, out: Path, texts: Mapping[str, str], config: ServerConfig) -> dict[str, Any]:
        """Open the store like a server, then move it into place; texts: further files. Returns its `info`."""
        for name, text in texts.items():
            write_whole(self.folder / name, text.encode())
        with closing(Store(JournalLocation(self.folder), self.site, config, time.time_ns)) as store:
            info = store.info()
        shutil.rmtree(self.work)
        self.folder.replace(out)
        sync_folder(out.parent)
        return info


@contextmanager
def making(folder: Path, site: SiteConfig, descends: tuple[str, ...], rows: int) -> Iterator[NewStore]:
    """Make a store in a folder, or resume; an error leaves nothing, or what the same command can reuse."""
    with hold_place(folder):
        try:
            (folder / WORK).mkdir(parents=True, exist_ok=True)
            yield NewStore(folder, _identity(folder, site, descends), site, rows)
        except (SitegridError, OSError) as error:
            problem = str(error)
            if isinstance(error, OSError):
                problem = f"{folder}: cannot be written: {error.strerror or error}"
            if _is_useful(folder):
                problem = f"{problem}; what is done is kept in {folder}, and the same command goes on"
            raise SitegridError(problem) from None
        finally:
            if folder.exists() and not _is_useful(folder):
                shutil.rmtree(folder)


def _identity(folder: Path, site: SiteConfig, descends: tuple[str, ...]) -> str:
    """The new store's id: of an empty journal, made now or by a killed fold."""
    try:
        with closing(JournalLocation(folder).open_file(site.name, site.frame, descends)) as journal:
            identity = journal.identity()
    except StoreError:
        if not _is_useful(folder):
            raise
        raise _of_another(folder) from None
    if identity.descends != descends:
        raise _of_another(folder)
    write_whole(folder / WORK / STORE_FILE, identity.id.encode())
    return identity.id


def _of_another(folder: Path) -> ConfigError:
    return ConfigError(folder, "is left from a fold of something else that was killed; remove it")


def _is_useful(folder: Path) -> bool:
    """Whether finished work can be reused."""
    return any((folder / WORK).glob("evidence-*"))
