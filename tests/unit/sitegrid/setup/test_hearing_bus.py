"""`probe` on a bus."""

from __future__ import annotations

from itertools import chain

from agents.drivers.can.buses import CanFrame
from sitegrid.setup.files import agent_text
from sitegrid.setup.hearing import missing
from sitegrid.setup.hearing_bus import heard_bus
from sitegrid.setup.listening import address_of, listen
from tests.unit.agents.drivers.test_can import EEC1, frame

STATED = [
    EEC1,
    frame(65265, vehicle_speed=3.0),
    frame(65247),  # no values available
    frame(64000),
    frame(61442, 3, driveline_engaged=1),
]


def second(*frames: tuple[int, bytes]) -> list[CanFrame]:
    """These frames at 10 Hz for a second."""
    return list(chain.from_iterable([CanFrame(i, True, data, 1e9 + n / 10) for i, data in frames] for n in range(11)))


def test_groups_with_values_are_listed_and_what_they_feed() -> None:
    heard = heard_bus("can0", second(*STATED))
    assert heard.messages == {"CCVS1 (PGN 65265)": 10.0, "EEC1 (PGN 61444)": 10.0, "ETC1 (PGN 61442)": 10.0}
    assert (heard.kind, heard.streams, heard.problem) == ("can", ("engine", "gearbox", "speed"), "")
    assert list(missing([heard])) == ["position", "slope"]
    assert "# can0 is a bus with engine, gearbox, speed: docs/can.md has its tables." in agent_text(
        "t-1", "truck", [heard]
    )


def test_what_is_missing_is_named() -> None:
    assert heard_bus("can0", second(EEC1)).problem == "no value of wheel speed (CCVS1), clutch and shifts (ETC1)"
    assert heard_bus("can0", []).problem.startswith("the bus is silent")
    foreign = heard_bus("can0", second(frame(64000)))
    assert (foreign.kind, foreign.problem[:10]) == ("", "11 frames,")
    place = heard_bus("can0", second(frame(129025, latitude=49.0, longitude=8.4)))
    assert (place.streams, place.problem) == (("fix",), "")


def test_addresses_of_buses_are_taken_as_they_are() -> None:
    assert address_of("virtual://a") == "virtual://a"
    assert address_of("can7") == "can7"  # even if this host lacks it
    problem = listen("can7", 0.1).problem
    assert problem.startswith(("no such bus: plug the adapter in", "this host's kernel has no SocketCAN: load"))
    assert address_of("udp_multicast://239.0.0.1:5000") == "udp_multicast://239.0.0.1:5000"
