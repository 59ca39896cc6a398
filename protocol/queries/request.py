"""What all queries and commands are: frozen records whose fields say which parameters of a selector they are.

A field is declared once, by `asked` or `grouped`. From it follow the selector both ways, options of the command line,
parameters of HTTP and their description. A field that several queries have stands in a class that they share.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields
from enum import Enum, auto
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

from protocol.errors import QueryError, Refusal
from protocol.queries.parameters import MAX_WAIT_S, STAMP, Parameters, ValueKind, count, flag, number

T = TypeVar("T")
REPAIRS = "1: roads whose ground changed are read from the samples since; 0: from all samples"
ASKED = "asked"


@dataclass(frozen=True)
class Parameter:
    """One parameter of a selector. help: what it is, a line for people."""

    name: str
    help: str
    kind: ValueKind

    def read(self, parameters: Parameters) -> Any:
        """Its value; QueryError where it is missing, or wrong."""
        if self.name not in parameters:
            raise QueryError(Refusal.MISSING_FIELD, f"parameter `{self.name}` is missing")
        return self.kind.read(self.name, parameters[self.name])

    def write(self, value: Any) -> dict[str, str]:
        """Undo `read`; empty where it is left out."""
        text = self.kind.write(value)
        return {self.name: text} if text else {}

    def check(self, value: Any) -> None:
        """Refuse a value of the wrong size."""
        self.kind.check(self.name, value)


@dataclass(frozen=True)
class Group:
    """Parameters that make up one value. read: of those that are given; write, check: as of a parameter."""

    parameters: tuple[Parameter, ...]
    read: Callable[[Parameters], Any]
    write: Callable[[Any], dict[str, str]]
    check: Callable[[Any], None] = lambda _: None


def asked(kind: ValueKind, name: str, help: str, default: Any = MISSING) -> Any:  # noqa: A002 - as argparse has it
    """A field of a request that is one parameter."""
    one = Parameter(name, help, kind)
    if default is not None:
        return grouped(Group((one,), one.read, one.write, one.check), default)
    optional = Group((one,), one.read, lambda value: {} if value is None else one.write(value), _if_given(one.check))
    return grouped(optional, None)


def _if_given(check: Callable[[Any], None]) -> Callable[[Any], None]:
    return lambda value: None if value is None else check(value)


def grouped(group: Group, default: Any = MISSING) -> Any:
    """A field of a request that is made up of several parameters."""
    return field(default=default, metadata={ASKED: group})


def groups(cls: Any) -> tuple[tuple[Field[Any], Group], ...]:
    """Fields of a class of requests, and their parameters; worked out once."""
    if cls not in _GROUPS:
        _GROUPS[cls] = tuple((one, one.metadata[ASKED]) for one in fields(cls))
    return _GROUPS[cls]


_GROUPS: dict[Any, tuple[tuple[Field[Any], Group], ...]] = {}


def parameters_of(cls: type[Request[Any]]) -> dict[str, Parameter]:
    """All parameters of a class of requests, by name."""
    return {one.name: one for _, group in groups(cls) for one in group.parameters}


class Codec(NamedTuple):
    """Bytes of an answer, both ways."""

    encode: Callable[[Any], bytes]
    decode: Callable[[bytes], Any]


@dataclass(frozen=True)
class Request(Generic[T]):
    """A query or a command, whose answer is a T. name: as on the wire. codec: of its answer."""

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
        """Parameters of its selector."""
        return {
            name: text
            for one, group in groups(type(self))
            for name, text in group.write(getattr(self, one.name)).items()
        }


R = TypeVar("R", bound=Request[Any])


def parse(what: str, table: Mapping[str, type[R]], name: str, parameters: Parameters) -> R:
    """Undo `parameters` of the request `name` of a table; QueryError says what is wrong with which parameter."""
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
    """Whom a client asks first, and whom where that one does not answer."""

    FOLLOWER = auto()  # then the server
    SERVER = auto()  # then a follower, which knows a moment later what the server's events tell
    SERVER_ALONE = auto()


class Size(Enum):
    """What it takes to answer: less than a page, as much as a piece of a region, or a search over the map."""

    SMALL = auto()
    PIECE = auto()
    SEARCH = auto()


@dataclass(frozen=True)
class MapQuery(Request[T]):
    """A query of the map.

    help: what it asks, for people. ask_first, size: see there. after, wait_s: see `Fresh`.
    """

    help: ClassVar[str]
    ask_first: ClassVar[AskFirst] = AskFirst.FOLLOWER
    size: ClassVar[Size] = Size.SMALL
    after = 0
    wait_s = 0.0

    @property
    def is_long(self) -> bool:
        """Whether it is made of far more than it holds, and so keeps a thread for long."""
        return False

    @property
    def reads_past(self) -> bool:
        """Whether the server has to read its journal for it, which takes a while."""
        return False

    @property
    def may_read_journal(self) -> bool:
        """Whether the server may have to, if only as the first one since its start."""
        return self.reads_past


@dataclass(frozen=True, kw_only=True)
class Fresh(MapQuery[T]):
    """A query that can wait. after: answered only once this journal row is merged; wait_s: how long to wait for it."""

    after: int = asked(count(), "after", "answer once this journal row is merged", 0)
    wait_s: float = asked(number(0.0, MAX_WAIT_S, "s"), "wait", "how long to wait for it [s], 0 to 60", 10.0)

    def parameters(self) -> dict[str, str]:
        """As of any request; a time to wait means nothing without a row."""
        parameters = super().parameters()
        return parameters if self.after else {name: text for name, text in parameters.items() if name != "wait"}


@dataclass(frozen=True, kw_only=True)
class AsOf(MapQuery[T]):
    """A query of the map as it was. as_of_ns: from samples stamped so or earlier; None: as it is."""

    as_of_ns: int | None = asked(STAMP, "as_of", "the map as of this time", None)

    @property
    def reads_past(self) -> bool:
        """See `MapQuery`."""
        return self.as_of_ns is not None


@dataclass(frozen=True, kw_only=True)
class Repaired(AsOf[T]):
    """A query of cells. repairs: those of a road whose ground changed, as `worklist` has it, from the samples since."""

    repairs: bool = asked(flag(usual=False), "repairs", f"{REPAIRS} (default 0)", default=False)

    @property
    def reads_past(self) -> bool:
        """See `MapQuery`."""
        return self.as_of_ns is not None or self.repairs


@dataclass(frozen=True, kw_only=True)
class Compared(Repaired[T]):
    """A query of values that can be compared. minus_ns: less the map as of that time."""

    minus_ns: int | None = asked(STAMP, "minus", "subtract the map as of this time", None)

    @property
    def times(self) -> tuple[int | None, ...]:
        """Times of the maps that are read: this one, and that which is taken off it."""
        return (self.as_of_ns,) if self.minus_ns is None else (self.as_of_ns, self.minus_ns)

    @property
    def reads_past(self) -> bool:
        """See `MapQuery`."""
        return self.times != (None,) or self.repairs
