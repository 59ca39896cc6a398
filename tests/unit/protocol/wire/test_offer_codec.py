"""An offer in an acknowledgement: whatever is in it, the acknowledgement holds."""

import math
from typing import Any

import pytest

from protocol.errors import MessageError, Refusal
from protocol.wire.codec import decode_reply, encode_reply
from protocol.wire.messages import Ack, CalibrationOffer
from protocol.wire.offer_codec import decode_offer, encode_offer

OFFER = CalibrationOffer("loader-1", 1_750_000_000_000_000_000, 0.004, -0.05, 4e-7, 2e-5, 1e-6)
STORE = "0123456789abcdef"


def test_an_offer_comes_back_from_an_acknowledgement() -> None:
    ack = decode_reply(encode_reply(Ack(3, 1, store=STORE, offer=encode_offer(OFFER))))
    assert isinstance(ack, Ack)
    assert decode_offer(ack.offer) == OFFER


@pytest.mark.parametrize(
    ("changes", "reason", "field"),
    [
        ({"zero": math.nan}, Refusal.NOT_FINITE, "zero"),
        ({"zero": 0.201}, Refusal.OUT_OF_RANGE, "zero"),
        ({"zero": "0"}, Refusal.WRONG_TYPE, "zero"),
        ({"scale": -0.51}, Refusal.OUT_OF_RANGE, "scale"),
        ({"scale": math.inf}, Refusal.NOT_FINITE, "scale"),
        ({"zero_var": 0.0}, Refusal.OUT_OF_RANGE, "zero_var"),
        ({"zero_var": -1e-6}, Refusal.OUT_OF_RANGE, "zero_var"),
        ({"scale_var": 1.1}, Refusal.OUT_OF_RANGE, "scale_var"),
        ({"covariance": 1e-5}, Refusal.OUT_OF_RANGE, "covariance"),
        ({"covariance": None}, Refusal.MISSING_FIELD, "covariance"),
        ({"machine": "*"}, Refusal.OUT_OF_RANGE, "machine"),
        ({"stamp_ns": 0}, Refusal.OUT_OF_RANGE, "stamp_ns"),
        ({"stamp_ns": 1.0}, Refusal.WRONG_TYPE, "stamp_ns"),
    ],
)
def test_a_bad_offer_is_named_and_its_acknowledgement_holds(changes: Any, reason: Refusal, field: str) -> None:
    ack = decode_reply(encode_reply(Ack(3, 1, store=STORE, offer={**encode_offer(OFFER), **changes})))
    assert (ack.watermark, ack.store) == (3, STORE)
    with pytest.raises(MessageError) as caught:
        decode_offer(ack.offer)
    assert (caught.value.reason, caught.value.field) == (reason, field)


@pytest.mark.parametrize("table", [7, "offer", [1.0], b"\x00"])
def test_what_is_no_table_is_no_offer(table: Any) -> None:
    ack = decode_reply(encode_reply(Ack(3, 1, store=STORE, offer=table)))
    with pytest.raises(MessageError, match="map expected"):
        decode_offer(ack.offer)
