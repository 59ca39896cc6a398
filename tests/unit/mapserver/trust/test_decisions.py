from dataclasses import asdict

import pytest

from mapserver.journal.rows import Event
from mapserver.trust.auditor import Verdict
from mapserver.trust.decisions import AUDIT, DISTRUST_AFTER, PERSON, TRUST_AFTER, TrustDecision, TrustDecisions
from mapserver.trust.judgement import Reason

BAD = Verdict("c", (Reason.GAIN, Reason.OFFSET), {"gain": 1.6}, True)
GOOD = Verdict("c", (), {"gain": 1.0}, False, frozenset({Reason.GAIN, Reason.OFFSET, Reason.DISAGREES}))


def judged(decisions: TrustDecisions, verdict: Verdict, times: int) -> list[TrustDecision]:
    """What the audit decides on the same verdict again and again; each decision counts at once."""
    made = []
    for stamp_ns in range(1, times + 1):
        for decision in decisions.judge({verdict.machine: verdict}, stamp_ns):
            decisions.add(decision)
            made.append(decision)
    return made


def test_a_machine_is_distrusted_once_the_verdict_stands():
    decisions = TrustDecisions([])
    assert judged(decisions, BAD, DISTRUST_AFTER - 1) == []
    (decision,) = judged(decisions, BAD, 3)
    assert (decision.machine, decision.trusted, decision.by, decision.reason) == ("c", False, AUDIT, "gain, offset")
    assert decision.evidence == {"gain": 1.6}
    assert decisions.distrusted == {"c"}


def test_a_doubtful_verdict_begins_to_count_anew():
    decisions = TrustDecisions([])
    for _ in range(5):
        assert judged(decisions, BAD, DISTRUST_AFTER - 1) == []
        assert judged(decisions, GOOD, 1) == []


def test_a_machine_that_agrees_again_is_trusted_again_but_later():
    decisions = TrustDecisions([])
    judged(decisions, BAD, DISTRUST_AFTER)
    assert judged(decisions, GOOD, TRUST_AFTER - 1) == []
    (decision,) = judged(decisions, GOOD, 1)
    assert decision.trusted
    assert decisions.distrusted == frozenset()
    assert TRUST_AFTER > DISTRUST_AFTER


@pytest.mark.parametrize("agrees", [(), (Reason.GAIN,), (Reason.OFFSET, Reason.DISAGREES, Reason.CLOCK)])
def test_a_machine_of_which_nothing_shows_that_it_agrees_again_stays_out(agrees):
    decisions = TrustDecisions([])
    judged(decisions, BAD, DISTRUST_AFTER)
    silent = Verdict("c", (), {"cells": 0}, False, frozenset(agrees))
    assert judged(decisions, silent, 3 * TRUST_AFTER) == []
    assert judged(decisions, GOOD, TRUST_AFTER - 1) == []
    assert judged(decisions, silent, 1) == []
    assert judged(decisions, GOOD, TRUST_AFTER - 1) == [], "four in a row"


@pytest.mark.parametrize("trusted", [True, False])
def test_what_a_person_decided_stands_against_the_audit(trusted):
    decisions = TrustDecisions([])
    decisions.add(TrustDecision("c", trusted, PERSON, "because", 1))
    assert judged(decisions, BAD if trusted else GOOD, 20) == []
    assert decisions.distrusted == (frozenset() if trusted else {"c"})


def test_a_decision_handed_back_lets_the_audit_decide():
    decisions = TrustDecisions([])
    decisions.add(TrustDecision("c", False, PERSON, "because", 1))
    decisions.add(TrustDecision("c", True, AUDIT, "left to the audit", 2))
    assert decisions.distrusted == frozenset()
    assert judged(decisions, BAD, DISTRUST_AFTER)


@pytest.mark.parametrize("reasons", [(Reason.BEYOND_DATA_SHEET,), (Reason.OFFSET, Reason.BEYOND_DATA_SHEET)])
def test_a_machine_beyond_its_data_sheet_is_let_in_by_a_person_alone(reasons):
    decisions = TrustDecisions([])
    judged(decisions, Verdict("c", reasons, {}, True), DISTRUST_AFTER)
    assert judged(decisions, GOOD, 20) == []
    assert decisions.distrusted == {"c"}
    decisions.add(TrustDecision("c", True, PERSON, "its samples are corrected", 30))
    assert decisions.distrusted == frozenset()
    assert judged(decisions, Verdict("c", reasons, {}, True), 20) == []


def test_decisions_come_back_from_events_the_newest_of_each_machine():
    made = [
        TrustDecision("c", False, AUDIT, "gain", 1, {"gain": 1.6}),
        TrustDecision("b", False, PERSON, "broken", 2),
        TrustDecision("c", True, PERSON, "repaired", 3),
    ]
    decisions = TrustDecisions(Event(i, "trust", d.stamp_ns, asdict(d)) for i, d in enumerate(made, 1))
    assert decisions.distrusted == {"b"}
    assert decisions.newest("c") == made[2]
    assert decisions.newest("b") == made[1]
