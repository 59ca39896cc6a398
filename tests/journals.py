"""Journals in tests."""

from mapserver.journal.history import History
from mapserver.journal.location import JournalLocation
from mapserver.journal.sqlite.reader import SqliteQueries


def history_beside(journal: SqliteQueries) -> History:
    """A journal with its archive."""
    return History(journal, JournalLocation(journal.path.parent).archive)
