"""The error tree. Each error makes its one-line message: what is wrong, where, and what to do."""

from enum import StrEnum


class Refusal(StrEnum):
    """Why something was refused; also the counter's name in `info` and health."""

    TOO_LARGE = "too_large"
    NOT_MSGPACK = "not_msgpack"
    VERSION = "version"
    MISSING_FIELD = "missing_field"
    WRONG_TYPE = "wrong_type"
    COLUMN_LENGTH = "column_length"
    NOT_FINITE = "not_finite"
    OUT_OF_RANGE = "out_of_range"
    COVARIANCE = "covariance"
    OUTSIDE_SITE = "outside_site"
    SCATTERED = "scattered"
    FIRST_SEQ = "first_seq"
    GAP = "gap"
    WRONG_FRAME = "wrong_frame"
    WRONG_MACHINE = "wrong_machine"
    WALL_CLOCK = "wall_clock"
    FAR_FUTURE = "far_future"
    SERVER_CLOCK = "server_clock"
    OTHER_STORE = "other_store"
    NOT_WRITER = "not_writer"
    UNSIGNED = "unsigned"
    OVERLOADED = "overloaded"
    STORE = "store"
    UNKNOWN_PARAMETER = "unknown_parameter"
    UNKNOWN_LAYER = "unknown_layer"
    UNKNOWN_QUERY = "unknown_query"
    UNKNOWN_MACHINE = "unknown_machine"
    AFTER_TIMEOUT = "after_timeout"
    EXPIRED = "expired"
    NOT_HERE = "not_here"


MAX_LINE = 500  # characters


def one_line(text: str) -> str:
    """Foreign text as one line: unprintable characters escaped, its end cut off."""
    if len(text) <= MAX_LINE and text.isprintable():
        return text
    plain = text[:MAX_LINE]
    if not plain.isprintable():
        plain = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in plain)
    if len(plain) > MAX_LINE - 3 and plain != text:
        plain = f"{plain[: MAX_LINE - 3]}..."
    return plain


class SitegridError(Exception):
    """Base of this project's errors, each one line whatever it quotes."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))


class _PlaceError(SitegridError):
    """A problem at a place: file, key, folder, address."""

    def __init__(self, where: object, problem: str) -> None:
        super().__init__(f"{where}: {problem}")


class ConfigError(_PlaceError):
    """A wrong configuration file or value."""


class LogFolderError(_PlaceError):
    """A log folder or manifest cannot be read."""


class MessageError(SitegridError):
    """A message, or a value in it, is refused.

    reason: its counter. field, row: the place, if any (rows from 0).
    """

    def __init__(self, reason: Refusal, problem: str, *, field: str | None = None, row: int | None = None) -> None:
        place = f"{field}[{row}]" if field is not None and row is not None else field
        super().__init__(f"{place}: {problem}" if place else problem)
        self.reason = reason
        self.field = field
        self.row = row


class RowError(SitegridError):
    """A row of a log is refused. reason: its counter."""

    def __init__(self, reason: str, problem: str) -> None:
        super().__init__(problem)
        self.reason = reason


class QueryError(SitegridError):
    """A malformed or refused map query. retry_after_s: when to ask again, 0 if never."""

    def __init__(self, reason: Refusal | str, problem: str, retry_after_s: float = 0.0) -> None:
        super().__init__(problem)
        self.reason = str(reason)
        self.retry_after_s = retry_after_s


class LinkError(_PlaceError):
    """Nobody answered on the network."""


class StoreError(_PlaceError):
    """An unusable database or snapshot."""
