import math

import pytest

from protocol.errors import MessageError, Refusal
from protocol.machine.readings import KINDS, MAX_STAMP_NS, columns, parse_reading

MIDDLE = {kind: tuple((low + high) / 2 for low, high in cls.limits.values()) for kind, cls in KINDS.items()}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("value", "reason"), [(math.nan, Refusal.NOT_FINITE), (math.inf, Refusal.NOT_FINITE), (-1e30, Refusal.OUT_OF_RANGE)]
)
def test_each_bad_value_is_named(kind, value, reason):
    for i, name in enumerate(columns(kind)):
        values = (*MIDDLE[kind][:i], value, *MIDDLE[kind][i + 1 :])
        with pytest.raises(MessageError) as caught:
            parse_reading(kind, "s-1", 1, values)
        assert (caught.value.reason, caught.value.field) == (reason, f"s-1.{name}")


@pytest.mark.parametrize("stamp", [0, -1, MAX_STAMP_NS + 1])
def test_stamp_that_is_no_time_is_refused(stamp):
    with pytest.raises(MessageError, match=r"s-1\.stamp_ns"):
        parse_reading("torque", "s-1", stamp, (1.0,))
