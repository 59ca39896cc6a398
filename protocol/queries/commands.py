"""Commands to a map server, with keys of their own for access rules (docs/protocol.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from protocol.errors import QueryError, Refusal
from protocol.queries.answer_codec import decode_info, decode_machine, encode_info, encode_machine
from protocol.queries.answers import MapInfo, TrustAnswer
from protocol.queries.calibration import CalibrationAnswer, decode_calibration, encode_calibration
from protocol.queries.parameters import LINE, MAX_WAIT_S, choice, name_of, number, refusal
from protocol.queries.request import Codec, Request, asked, parse
from protocol.wire.fields import STORE_ID

# Bounds of corrections by a person: an accelerometer on its side, torque of twice or half.
MOST_OFF = {"zero": 0.5, "scale": 0.9, "across": 0.5}
_VERDICTS = choice({"yes": True, "no": False, "auto": None})
_STORE = name_of(STORE_ID, "an id of a store; that is 16 hex digits, as an agent names it")
_WAIT = number(0.0, MAX_WAIT_S, "s")
WAIT = "how long to wait for the map to be folded again [s]"


@dataclass(frozen=True)
class TrustCommand(Request[TrustAnswer]):
    """Trust a machine or not.

    trusted: None leaves it to the server. reason: one line, required to distrust. wait_s: for the new fold of the map.
    """

    machine: str = asked(name_of(), "machine", "its name")
    trusted: bool | None = asked(_VERDICTS, "trusted", "yes, no, or auto: the server decides")
    reason: str = asked(LINE, "reason", "one line; required to distrust", "")
    wait_s: float = asked(_WAIT, "wait", WAIT, 30.0)

    name = "trust"
    codec = Codec(encode_machine, decode_machine)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.trusted is False and not self.reason:
            raise _without_reason("say why the machine is distrusted")


@dataclass(frozen=True)
class AcceptCommand(Request[MapInfo]):
    """Let the server's store replace a lost one. store: its id; reason: one line."""

    store: str = asked(_STORE, "store", "id of the store that is gone")
    reason: str = asked(LINE, "reason", "one line: what became of it", "")

    name = "accept"
    codec = Codec(encode_info, decode_info)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.reason:
            raise _without_reason("say what became of that store")


@dataclass(frozen=True)
class CalibrateCommand(Request[CalibrationAnswer]):
    """Calibrate all machines with all samples, or decide one machine's correction.

    machine: empty for all. zero, scale, across: for all its samples, see `protocol.queries.calibration.CorrectedSpan`;
    None if not given. auto: return it to the server. reason: one line, required with values. wait_s: for the new fold.
    """

    machine: str = asked(name_of(), "machine", "the one that is decided about; without it all", "")
    zero: float | None = asked(number(-0.5, MOST_OFF["zero"]), "zero", "of the balance [-]", None)
    scale: float | None = asked(number(-0.9, MOST_OFF["scale"]), "scale", "share of the torque that is not there", None)
    across: float | None = asked(number(-0.5, MOST_OFF["across"]), "across", "slope to the left, too high [m/m]", None)
    auto: bool = asked(choice({"yes": True, "no": False}, "no"), "auto", "yes: the server decides", default=False)
    reason: str = asked(LINE, "reason", "one line; required with values", "")
    wait_s: float = asked(_WAIT, "wait", WAIT, 30.0)

    name = "calibrate"
    codec = Codec(encode_calibration, decode_calibration)

    def __post_init__(self) -> None:
        super().__post_init__()
        if bool(self.machine) != bool(self.values or self.auto):
            problem = (
                "`machine` comes with one of `zero`, `scale`, `across`, or with `auto=yes`; neither calibrates all"
            )
            raise QueryError(Refusal.MISSING_FIELD, problem)
        if self.values and self.auto:
            raise refusal("auto", "with values of a person it means nothing")
        if self.values and not self.reason:
            raise _without_reason("say where the values are from")

    @property
    def values(self) -> dict[str, float]:
        """Given values by name."""
        given = {"zero": self.zero, "scale": self.scale, "across": self.across}
        return {name: value for name, value in given.items() if value is not None}


COMMANDS: dict[str, type[Request[Any]]] = {cls.name: cls for cls in (TrustCommand, AcceptCommand, CalibrateCommand)}


def parse_command(name: str, parameters: Mapping[str, str]) -> Request[Any]:
    """Parse a command; QueryError names the wrong parameter."""
    return parse("command", COMMANDS, name, parameters)


def _without_reason(problem: str) -> QueryError:
    return QueryError(Refusal.MISSING_FIELD, f"parameter `reason` is missing: {problem}")
