"""Journals as tests look at them."""

from mapserver.journal.history import History
from mapserver.journal.location import JournalLocation
from mapserver.journal.sqlite.reader import SqliteQueries


def history_beside(journal: SqliteQueries) -> History:
    """A journal and the archive beside it."""
    return History(journal, JournalLocation(journal.path.parent).archive)
