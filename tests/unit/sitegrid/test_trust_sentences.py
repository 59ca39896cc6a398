"""Machines in words: reasons with figures, calibrations with sources."""

from typing import Any

import pytest

from sitegrid.doctor.network import check_machines
from sitegrid.trust_sentences import MOST_LISTED, calibrated, calibrations, rolls, why
from tests.unit.records import machine_state

CALIBRATED = {"zero": -0.0034, "zero_std": 0.0005, "torque_gain": 1.49, "torque_gain_std": 0.012}
CALIBRATED |= {"zero_by": ("heights", "crossings"), "torque_gain_by": ()}


def test_how_a_machine_rolls_is_said_with_its_doubt_and_what_it_costs() -> None:
    known = {"rolls": 0.25, "rolls_std": 0.06, "rolls_named": True, "rolls_litres_ph": 3.04}
    causes, costs = "on the same ground: tyre pressure, brake, torque scale", "costs about 3 l/h"
    odd = machine_state("b", evidence=known)
    assert why(odd) == f"rolls 25 +- 6 % harder than the others {causes}; {costs}"
    less = known | {"rolls": -0.2, "rolls_named": False, "rolls_litres_ph": -2.0}
    of_two = f"rolls 20 +- 6 % easier than some others, or these than it, {causes}"
    assert rolls(machine_state("b", evidence=less)) == of_two
    assert rolls(machine_state("b")) == rolls(machine_state("b", evidence={"rolls": "new"})) == ""
    assert check_machines([odd, machine_state("c")]).message.startswith("b rolls 25 +- 6 %")


@pytest.mark.parametrize(
    ("gain", "std", "said"),
    [
        (1.1, 0.02, "torque looks 10 +- 2 % high: reference torque of its engine, its sensor, or its mass"),
        (0.9, 0.01, "torque looks 10 +- 1 % low: reference torque of its engine, its sensor, or its mass"),
        (1.04, 0.001, ""),
        (1.1, 0.04, ""),
    ],
)
def test_a_wrong_reference_torque_is_one_sentence_once_the_ground_shows_it(gain: float, std: float, said: str) -> None:
    known = {"torque_gain": gain, "torque_gain_std": std, "torque_gain_by": ("ground",)}
    assert why(machine_state("b", evidence=known)) == said


@pytest.mark.parametrize(
    ("reasons", "evidence", "words"),
    [
        (("offset",), {"offset_east_m": 3.0, "offset_north_m": -4.0}, "places 5.0 m off"),
        (("clock",), {"clock_s": -600.0}, "clock -600 s off"),
        (("disagrees",), {"agreement": 0.41}, "agrees with the others on 41 % of the ground"),
        (
            ("beyond_data_sheet",),
            CALIBRATED,
            (
                "beyond its data sheet: torque reads 1.49 times what it should, accelerometer -0.0034 off; "
                "a person may trust it"
            ),
        ),
        (("gain", "stuck"), {"gain": 0.6}, "measures 0.60 times the resistance that the others do; stuck"),
        (("offset",), {}, "offset"),
        (("new",), {}, "new"),
    ],
)
def test_reasons_are_said_in_words_with_their_figures(
    reasons: tuple[str, ...], evidence: dict[str, Any], words: str
) -> None:
    decided = {"reason": ", ".join(reasons), "by": "audit"}
    assert why(machine_state("b", reasons=reasons, evidence=evidence, **decided)) == words
    person = machine_state("b", reasons=reasons, evidence=evidence, by="person", reason="hit a wall")
    assert why(person) == f"{words}; hit a wall"


def test_the_calibration_of_a_machine_says_what_shows_it() -> None:
    machine = machine_state("b", evidence=CALIBRATED)
    assert calibrated(machine, "zero") == "-0.0034 +- 0.0005, heights+crossings"
    assert calibrated(machine, "torque_gain") == "1.4900 +- 0.0120, data sheet"
    assert calibrated(machine_state("b"), "zero") == ""
    assert why(machine) == ""


def test_calibrations_that_the_ground_shows_are_listed_and_no_others() -> None:
    unknown = CALIBRATED | {"zero_by": ()}
    machines = [machine_state("a", evidence=CALIBRATED), machine_state("b", evidence=unknown), machine_state("c")]
    assert calibrations(machines) == [
        "a: zero -0.0034 +- 0.0005, heights+crossings",
        "  torque x 1.4900 +- 0.0120, data sheet",
    ]
    many = calibrations([machine_state(f"m{i}", evidence=CALIBRATED) for i in range(MOST_LISTED + 3)])
    assert (len(many), many[-1]) == (2 * MOST_LISTED + 1, "and of 3 more")
