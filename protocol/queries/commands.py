"""Commands to a map server, on keys of their own so that access rules can tell them from queries (docs/protocol.md)."""

from collections.abc import Mapping
from dataclasses import dataclass

from protocol.errors import QueryError, Refusal
from protocol.queries import parameters as ps
from protocol.site.site_config import NAME

MAX_WAIT_S = 60.0
_WORDS = {"yes": True, "no": False, "auto": None}
_NAMES = ("machine", "trusted", "reason", "wait")


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


def encode_command(command: TrustCommand) -> dict[str, str]:
    """Selector parameters."""
    word = next(word for word, trusted in _WORDS.items() if trusted is command.trusted)
    parameters = {"machine": command.machine, "trusted": word, "wait": ps.text_of(command.wait_s)}
    return parameters | ({"reason": ps.quoted(command.reason)} if command.reason else {})


def parse_command(name: str, parameters: Mapping[str, str]) -> TrustCommand:
    """Parse the parameters of the command `name`; QueryError says what is wrong with which of them."""
    if name != TrustCommand.name:
        raise QueryError(Refusal.UNKNOWN_QUERY, f"command `{name[:40]}` is not known; known: {TrustCommand.name}")
    ps.check_known(name, parameters, _NAMES)
    machine, word = ps.required(parameters, "machine"), ps.required(parameters, "trusted")
    if not NAME.fullmatch(machine):
        raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `machine`: {machine[:70]!r} is not a name")
    if word not in _WORDS:
        raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `trusted`: {word[:40]!r} is none of {', '.join(_WORDS)}")
    reason = ps.free_text(parameters, "reason")
    if word == "no" and not reason:
        raise QueryError(Refusal.MISSING_FIELD, "parameter `reason` is missing: say why the machine is distrusted")
    return TrustCommand(machine, _WORDS[word], reason, ps.seconds(parameters, "wait", 30.0, MAX_WAIT_S))
