"""Queries and commands: frozen records whose fields are selector parameters.

A field is declared once, by `asked` or `grouped`; selector, command line, HTTP parameters and descriptions follow.
Shared fields stand in a shared class.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields
from enum import Enum, auto
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

from protocol.errors import QueryError, Refusal
from protocol.queries.parameters import MAX_WAIT_S, STAMP, Parameters, ValueKind, count, number

T = TypeVar("T")
ASKED = "asked"


@dataclass(frozen=True)
class Parameter:
    """A selector parameter. help: one line for people."""

    name: str
    help: str
    kind: ValueKind

    def read(self, parameters: Parameters) -> Any:
        """Its value; QueryError if missing or wrong."""
        if self.name not in parameters:
            raise QueryError(Refusal.MISSING_FIELD, f"parameter `{self.name}` is missing")
        return self.kind.read(self.name, parameters[self.name])

    def write(self, value: Any) -> dict[str, str]:
        """Undo `read`; empty if left out."""
        text = self.kind.write(value)
        return {self.name: text} if text else {}

    def check(self, value: Any) -> None:
        """Refuse a value out of range."""
        self.kind.check(self.name, value)


@dataclass(frozen=True)
class Group:
    """Parameters of one value. read: from those given; write, check: as of a parameter."""

    parameters: tuple[Parameter, ...]
    read: Callable[[Parameters], Any]
    write: Callable[[Any], dict[str, str]]
    check: Callable[[Any], None] = lambda _: None


def asked(kind: ValueKind, name: str, help: str, default: Any = MISSING) -> Any:  # noqa: A002 - as argparse has it
    """A field of one parameter."""
    one = Parameter(name, help, kind)
    if default is not None:
        return grouped(Group((one,), one.read, one.write, one.check), default)
    optional = Group((one,), one.read, lambda value: {} if value is None else one.write(value), _if_given(one.check))
    return grouped(optional, None)


def _if_given(check: Callable[[Any], None]) -> Callable[[Any], None]:
    return lambda value: None if value is None else check(value)


def grouped(group: Group, default: Any = MISSING) -> Any:
    """A field of several parameters."""
    return field(default=default, metadata={ASKED: group})


def groups(cls: Any) -> tuple[tuple[Field[Any], Group], ...]:
    """Fields of a request class and their parameters, cached."""
    if cls not in _GROUPS:
        _GROUPS[cls] = tuple((one, one.metadata[ASKED]) for one in fields(cls))
    return _GROUPS[cls]


_GROUPS: dict[Any, tuple[tuple[Field[Any], Group], ...]] = {}


def parameters_of(cls: type[Request[Any]]) -> dict[str, Parameter]:
    """A request class's parameters by name."""
    return {one.name: one for _, group in groups(cls) for one in group.parameters}


class Codec(NamedTuple):
    """Bytes of an answer."""

    encode: Callable[[Any], bytes]
    decode: Callable[[bytes], Any]


@dataclass(frozen=True)
class Request(Generic[T]):
    """A query or command with an answer T. name: on the wire. codec: of the answer."""

    name: ClassVar[str]
    codec: ClassVar[Codec]

    def __post_init__(self) -> None:
        for one, group in groups(type(self)):
            group.check(getattr(self, one.name))

    def encode(self, answer: T) -> bytes:
        """Bytes of an answer."""
        return self.codec.encode(answer)

    def decode(self, data: bytes) -> T:
        """Undo `encode`."""
        answer: T = self.codec.decode(data)
        return answer

    def parameters(self) -> dict[str, str]:
        """Selector parameters."""
        return {
            name: text
            for one, group in groups(type(self))
            for name, text in group.write(getattr(self, one.name)).items()
        }


R = TypeVar("R", bound=Request[Any])


def parse(what: str, table: Mapping[str, type[R]], name: str, parameters: Parameters) -> R:
    """Undo `parameters` of the request `name` of a table; QueryError names the wrong parameter."""
    if name not in table:
        raise QueryError(Refusal.UNKNOWN_QUERY, f"{what} `{name[:40]}` is not known; known: {', '.join(table)}")
    cls = table[name]
    values, unknown = {}, set(parameters)
    for one, group in groups(cls):
        given = {p.name: parameters[p.name] for p in group.parameters if p.name in parameters}
        if given or one.default is MISSING:
            values[one.name] = group.read(given)
            unknown -= set(given)
    if unknown:
        takes = ", ".join(parameters_of(cls)) or "none"
        problem = f"parameter `{min(unknown)[:40]}` is not known; `{name}` takes {takes}"
        raise QueryError(Refusal.UNKNOWN_PARAMETER, problem)
    return cls(**values)


class AskFirst(Enum):
    """Whom a client asks first, then as fallback."""

    FOLLOWER = auto()  # then the server
    SERVER = auto()  # then a follower, which lags the server's events a little
    SERVER_ALONE = auto()


class Size(Enum):
    """Cost of an answer: below a page, a piece of a region, or a search over the map."""

    SMALL = auto()
    PIECE = auto()
    SEARCH = auto()


@dataclass(frozen=True)
class MapQuery(Request[T]):
    """A map query.

    help: for people. ask_first, size: see there. after, wait_s: see `Fresh`.
    """

    help: ClassVar[str]
    ask_first: ClassVar[AskFirst] = AskFirst.FOLLOWER
    size: ClassVar[Size] = Size.SMALL
    after = 0
    wait_s = 0.0

    @property
    def is_long(self) -> bool:
        """Whether it reads far more than it returns, and occupies a thread."""
        return False

    @property
    def reads_past(self) -> bool:
        """Whether the server must read its journal, which takes a while."""
        return False

    @property
    def may_read_journal(self) -> bool:
        """Whether it may have to, if only once since its start."""
        return self.reads_past


@dataclass(frozen=True, kw_only=True)
class Fresh(MapQuery[T]):
    """A query that can wait. after: journal row to be merged first; wait_s: timeout."""

    after: int = asked(count(), "after", "answer once this journal row is merged", 0)
    wait_s: float = asked(number(0.0, MAX_WAIT_S, "s"), "wait", "how long to wait for it [s], 0 to 60", 10.0)

    def parameters(self) -> dict[str, str]:
        """Without a row, the timeout is omitted."""
        parameters = super().parameters()
        return parameters if self.after else {name: text for name, text in parameters.items() if name != "wait"}


@dataclass(frozen=True, kw_only=True)
class AsOf(MapQuery[T]):
    """A query of a past map. as_of_ns: from samples up to this stamp; None: now."""

    as_of_ns: int | None = asked(STAMP, "as_of", "the map as of this time", None)

    @property
    def reads_past(self) -> bool:
        """See `MapQuery`."""
        return self.as_of_ns is not None


@dataclass(frozen=True, kw_only=True)
class Compared(AsOf[T]):
    """A query of comparable values. minus_ns: subtract the map as of this time."""

    minus_ns: int | None = asked(STAMP, "minus", "subtract the map as of this time", None)

    @property
    def times(self) -> tuple[int | None, ...]:
        """Times of the maps read: this one, then the subtracted one."""
        return (self.as_of_ns,) if self.minus_ns is None else (self.as_of_ns, self.minus_ns)

    @property
    def reads_past(self) -> bool:
        """See `MapQuery`."""
        return self.times != (None,)
