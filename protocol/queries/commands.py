"""Commands to a map server, on keys of their own so that access rules can tell them from queries (docs/protocol.md)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from protocol.errors import QueryError, Refusal
from protocol.queries import parameters as ps
from protocol.site.site_config import NAME
from protocol.wire.codec import STORE_ID

MAX_WAIT_S = 60.0
_WORDS = {"yes": True, "no": False, "auto": None}


@dataclass(frozen=True)
class TrustCommand:
    """Trust a machine or not.

    trusted: None leaves it to the server. reason: one line, required to distrust. wait_s: how long to wait for the map
    to be folded again with it, or without it.
    """

    machine: str
    trusted: bool | None
    reason: str = ""
    wait_s: float = 30.0

    name = "trust"


@dataclass(frozen=True)
class AcceptCommand:
    """Let the server's store take the place of another one, which is gone. store: its id; reason: one line."""

    store: str
    reason: str

    name = "accept"


Command = TrustCommand | AcceptCommand


def encode_command(command: Command) -> dict[str, str]:
    """Selector parameters."""
    if isinstance(command, AcceptCommand):
        return {"store": command.store, "reason": ps.quoted(command.reason)}
    word = next(word for word, trusted in _WORDS.items() if trusted is command.trusted)
    parameters = {"machine": command.machine, "trusted": word, "wait": ps.text_of(command.wait_s)}
    return parameters | ({"reason": ps.quoted(command.reason)} if command.reason else {})


def parse_command(name: str, parameters: Mapping[str, str]) -> Command:
    """Parse the parameters of the command `name`; QueryError says what is wrong with which of them."""
    if name not in _COMMANDS:
        raise QueryError(Refusal.UNKNOWN_QUERY, f"command `{name[:40]}` is not known; known: {', '.join(_COMMANDS)}")
    known, parse = _COMMANDS[name]
    ps.check_known(name, parameters, known)
    return parse(parameters)


def _parse_accept(parameters: ps.Parameters) -> AcceptCommand:
    store, reason = ps.required(parameters, "store"), ps.free_text(parameters, "reason")
    if not STORE_ID.fullmatch(store):
        problem = f"parameter `store`: {store[:40]!r} is no id of a store; that is 16 hex digits, as an agent names it"
        raise QueryError(Refusal.OUT_OF_RANGE, problem)
    if not reason:
        raise QueryError(Refusal.MISSING_FIELD, "parameter `reason` is missing: say what became of that store")
    return AcceptCommand(store, reason)


def _parse_trust(parameters: ps.Parameters) -> TrustCommand:
    machine, word = ps.required(parameters, "machine"), ps.required(parameters, "trusted")
    if not NAME.fullmatch(machine):
        raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `machine`: {machine[:70]!r} is not a name")
    if word not in _WORDS:
        raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `trusted`: {word[:40]!r} is none of {', '.join(_WORDS)}")
    reason = ps.free_text(parameters, "reason")
    if word == "no" and not reason:
        raise QueryError(Refusal.MISSING_FIELD, "parameter `reason` is missing: say why the machine is distrusted")
    return TrustCommand(machine, _WORDS[word], reason, ps.seconds(parameters, "wait", 30.0, MAX_WAIT_S))


_COMMANDS: dict[str, tuple[tuple[str, ...], Callable[[ps.Parameters], Command]]] = {
    TrustCommand.name: (("machine", "trusted", "reason", "wait"), _parse_trust),
    AcceptCommand.name: (("store", "reason"), _parse_accept),
}
