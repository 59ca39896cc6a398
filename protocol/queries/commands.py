"""Commands to a map server, on keys of their own so that access rules can tell them from queries (docs/protocol.md)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from protocol.errors import QueryError, Refusal
from protocol.queries import parameters as ps
from protocol.site.site_config import NAME
from protocol.wire.codec import STORE_ID

MAX_WAIT_S = 60.0
# By which a person may correct: an accelerometer that lies on its side, a torque that reads twice or half as much.
MOST_OFF = {"zero": 0.5, "scale": 0.9, "across": 0.5}
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


@dataclass(frozen=True)
class CalibrateCommand:
    """Calibrate all machines with all samples that there are, or decide what is taken off those of one.

    machine: empty for all. zero, scale, across: of that one, as in `protocol.queries.calibration.CorrectedSpan`, for
    all of its samples; None for what is not given. auto: leaves that machine to the server again. reason: one line,
    required with values. wait_s: how long to wait for the map to be folded again.
    """

    machine: str = ""
    zero: float | None = None
    scale: float | None = None
    across: float | None = None
    auto: bool = False
    reason: str = ""
    wait_s: float = 30.0

    name = "calibrate"

    @property
    def values(self) -> dict[str, float]:
        """Those that are given, by name."""
        given = {"zero": self.zero, "scale": self.scale, "across": self.across}
        return {name: value for name, value in given.items() if value is not None}


Command = TrustCommand | AcceptCommand | CalibrateCommand


def encode_command(command: Command) -> dict[str, str]:
    """Selector parameters."""
    if isinstance(command, AcceptCommand):
        return {"store": command.store, "reason": ps.quoted(command.reason)}
    if isinstance(command, CalibrateCommand):
        return _of_calibrate(command)
    word = next(word for word, trusted in _WORDS.items() if trusted is command.trusted)
    parameters = {"machine": command.machine, "trusted": word, "wait": ps.text_of(command.wait_s)}
    return parameters | ({"reason": ps.quoted(command.reason)} if command.reason else {})


def _of_calibrate(command: CalibrateCommand) -> dict[str, str]:
    parameters = {"machine": command.machine} if command.machine else {}
    parameters |= {name: ps.text_of(value) for name, value in command.values.items()}
    parameters |= {"auto": "yes"} if command.auto else {}
    parameters |= {"reason": ps.quoted(command.reason)} if command.reason else {}
    return parameters | {"wait": ps.text_of(command.wait_s)}


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


def _parse_calibrate(parameters: ps.Parameters) -> CalibrateCommand:
    machine = _machine(parameters) if "machine" in parameters else ""
    values = {name: ps.number(parameters, name) for name in MOST_OFF if name in parameters}
    auto, reason = parameters.get("auto", "no"), ps.free_text(parameters, "reason")
    if auto not in ("yes", "no"):
        raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `auto`: {auto[:40]!r} is none of yes, no")
    if beyond := [name for name, value in values.items() if abs(value) > MOST_OFF[name]]:
        problem = f"parameter `{beyond[0]}`: {values[beyond[0]]:g} is not between -{MOST_OFF[beyond[0]]:g} and"
        raise QueryError(Refusal.OUT_OF_RANGE, f"{problem} {MOST_OFF[beyond[0]]:g}")
    if bool(machine) != bool(values or auto == "yes"):
        problem = "`machine` comes with one of `zero`, `scale`, `across`, or with `auto=yes`; neither calibrates all"
        raise QueryError(Refusal.MISSING_FIELD, problem)
    if values and auto == "yes":
        raise QueryError(Refusal.OUT_OF_RANGE, "parameter `auto`: with values of a person it means nothing")
    if values and not reason:
        raise QueryError(Refusal.MISSING_FIELD, "parameter `reason` is missing: say where the values are from")
    wait_s = ps.seconds(parameters, "wait", 30.0, MAX_WAIT_S)
    return CalibrateCommand(machine, **values, auto=auto == "yes", reason=reason, wait_s=wait_s)


def _machine(parameters: ps.Parameters) -> str:
    machine = ps.required(parameters, "machine")
    if not NAME.fullmatch(machine):
        raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `machine`: {machine[:70]!r} is not a name")
    return machine


def _parse_trust(parameters: ps.Parameters) -> TrustCommand:
    machine, word = _machine(parameters), ps.required(parameters, "trusted")
    if word not in _WORDS:
        raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `trusted`: {word[:40]!r} is none of {', '.join(_WORDS)}")
    reason = ps.free_text(parameters, "reason")
    if word == "no" and not reason:
        raise QueryError(Refusal.MISSING_FIELD, "parameter `reason` is missing: say why the machine is distrusted")
    return TrustCommand(machine, _WORDS[word], reason, ps.seconds(parameters, "wait", 30.0, MAX_WAIT_S))


_COMMANDS: dict[str, tuple[tuple[str, ...], Callable[[ps.Parameters], Command]]] = {
    TrustCommand.name: (("machine", "trusted", "reason", "wait"), _parse_trust),
    AcceptCommand.name: (("store", "reason"), _parse_accept),
    CalibrateCommand.name: (("machine", *MOST_OFF, "auto", "reason", "wait"), _parse_calibrate),
}
