"""What a map server offers a machine for its calibration, as a table in an acknowledgement and back, fully checked."""

from dataclasses import asdict
from typing import Any

from protocol.errors import MessageError, Refusal
from protocol.machine.samples import LIMITS
from protocol.wire.codec import take, take_name, take_stamp
from protocol.wire.messages import CalibrationOffer

MOST_VAR = 1.0  # of zero and scale: more is no knowledge


def encode_offer(offer: CalibrationOffer) -> dict[str, Any]:
    """The table."""
    return asdict(offer)


def decode_offer(table: Any) -> CalibrationOffer:
    """Undo `encode_offer`; refused where a value is not plausible."""
    if not isinstance(table, dict):
        raise MessageError(Refusal.WRONG_TYPE, f"map expected, not {type(table).__name__}", field="offer")
    names = ("zero", "scale", "zero_var", "scale_var", "covariance")
    values = {name: take(table, name, float) for name in names}
    for name in ("zero", "scale"):
        low, high = LIMITS[f"applied_{name}"]
        _check(low <= values[name] <= high, name, f"{values[name]} is not between {low} and {high}")
        variance = values[f"{name}_var"]
        _check(0 < variance <= MOST_VAR, f"{name}_var", f"{variance} is not above 0, up to {MOST_VAR}")
    product = values["zero_var"] * values["scale_var"]
    _check(values["covariance"] ** 2 < product, "covariance", "not positive definite")
    return CalibrationOffer(take_name(table), take_stamp(table), **values)


def _check(holds: bool, field: str, problem: str) -> None:  # noqa: FBT001
    if not holds:
        raise MessageError(Refusal.OUT_OF_RANGE, problem, field=field)
