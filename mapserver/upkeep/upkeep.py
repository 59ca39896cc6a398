"""The upkeep: a thread beside the writer with seven jobs in turn, and one that rebuilds the map."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable, Mapping
from typing import Any

from mapserver.calibration.correction import SampleCorrections
from mapserver.calibration.decision import calibration_of, decided_by_person
from mapserver.calibration.select import MachineErrors, state_of
from mapserver.ingest.writer import Writer
from mapserver.past.past import StorePast
from mapserver.trust.decisions import AUDIT, PERSON, TrustDecision
from mapserver.upkeep.calibrating import Calibrating
from mapserver.upkeep.checkpointing import Checkpointing
from mapserver.upkeep.jobs import Archiving, Audit, ChangeSearch, Job, Publish
from mapserver.upkeep.refolding import Refolding
from mapserver.upkeep.road_repairs import Find, RoadRepairs
from mapserver.upkeep.snapshots import Snapshots
from protocol.errors import QueryError, Refusal, SitegridError, StoreError
from protocol.queries.answers import GroundChange
from protocol.queries.calibration import CalibrationAnswer
from protocol.queries.commands import CalibrateCommand

# Pause between turns, longer after much work, to limit the share of a core.
TURN_S, LATEST_S = 1.0, 5.0
SHARE = 0.2
END_S = 5.0
log = logging.getLogger("mapserver.upkeep.upkeep")


class Upkeep:
    """Machines and changes of one site. Thread-safe.

    publish: takes new and extended changes. find: as in `RoadRepairs`.
    """

    def __init__(self, writer: Writer, publish: Publish, past: StorePast, find: Find) -> None:
        self._writer = writer
        self._reader = reader = writer.location.reader()
        self._ending = threading.Event()
        self._refolding = Refolding(writer, past)
        refolding = self._refolding
        decide, shown = refolding.calibrate, refolding.shown
        self._calibrating = Calibrating(writer, past, decide, self._doubtful, shown, self._ending)
        self._audit = Audit(writer, reader, self._refolding.judge, self._known, self._ending)
        self._changes = ChangeSearch(writer, reader, publish, self._ending)
        self._checkpointing = Checkpointing(writer, reader, past, self._ending)
        archiving = Archiving(writer, reader, self._ending)
        jobs = (
            self._audit,
            self._changes,
            Snapshots(writer),
            archiving,
            self._checkpointing,
            self._calibrating,
            RoadRepairs(writer, find),
        )
        self._thread = threading.Thread(target=self._run, args=(jobs,), name="upkeep", daemon=True)
        self._thread.start()

    def changes(self, after: int = 0) -> list[GroundChange]:
        """Changes numbered above `after`."""
        return self._changes.changes(after)

    def machines(self) -> list[dict[str, Any]]:
        """State of every machine, as plain values."""
        sent = self._writer.run(lambda store: store.machines())
        return [self._machine(name, sent[name]) for name in sorted(sent)]

    def trust(self, machine: str, trusted: bool | None, reason: str, wait_s: float) -> dict[str, Any]:  # noqa: FBT001
        """Trust a machine or not, or leave it to the audit (None); waits for the map.

        Returns the machine's state. QueryError for an unknown machine, a failed write, or after wait_s, when the
        decision still stands.
        """
        self._require_known(machine)
        number = self._refolding.decide(self._decision(machine, trusted, reason))
        self._refolding.wait(number, wait_s)
        return next(row for row in self.machines() if row["name"] == machine)

    def calibration(self) -> CalibrationAnswer:
        """Corrections in the map, and calibrations of machines."""
        solved, solved_ns = self._calibrating.solved
        version, corrections, sent = self._writer.run(
            lambda store: (store.version, store.facts.corrections, store.machines())
        )
        machines = (
            calibration_of(name, self._refolding.calibration(name), solved.machines.get(name), corrections)
            for name in sorted(sent)
        )
        common = (solved_ns, solved.common.std, solved.common.reason)
        return CalibrationAnswer(version.store, version.row, version.fact, *common, tuple(machines))

    def correct(self, command: CalibrateCommand) -> None:
        """Set a machine's corrections, or leave them to the solver; waits as `calibrate`.

        QueryError as there, and for an unknown machine.
        """
        self._require_known(command.machine)
        stamp_ns = self._writer.run(lambda store: store.newest_ns)
        number = self._refolding.decide(decided_by_person(command, stamp_ns))
        self._refolding.wait(number, command.wait_s)

    def calibrate(self, wait_s: float) -> None:
        """Calibrate all machines with all that is journalled; waits for the map.

        QueryError if reading or writing fails, or after wait_s, when decisions still stand.
        """
        try:
            solved, now_ns = self._calibrating.solve()
        except StoreError as error:
            raise QueryError(Refusal.STORE, str(error)) from None
        if self._ending.is_set():
            raise QueryError(Refusal.AFTER_TIMEOUT, "the server is stopping, and nothing is decided; ask again later")
        number = self._refolding.calibrate(solved, now_ns, asked=True)
        self._refolding.wait(number, wait_s)

    def close(self) -> None:
        """End the threads; a solve that exceeds END_S ends with the process."""
        self._ending.set()
        self._refolding.close()
        self._thread.join(END_S)
        self._calibrating.close()
        if not self._thread.is_alive():
            self._checkpointing.close()
            self._reader.close()

    def _known(self) -> tuple[SampleCorrections, Mapping[str, MachineErrors]]:
        """Decided corrections, and machines' errors by the last solve, or an earlier one.

        A person's corrections are not measured, and prove no fault.
        """
        earlier = {one.machine: state_of(one) for one in self._refolding.solver_corrections()}
        return self._refolding.corrections(), earlier | dict(self._calibrating.states())

    def _require_known(self, machine: str) -> None:
        sent = self._writer.run(lambda store: store.machines())
        if machine not in sent:
            names = ", ".join(sorted(sent)) or "none"
            raise QueryError(Refusal.UNKNOWN_MACHINE, f"machine `{machine[:40]}` has sent nothing; known: {names}")

    def _doubtful(self) -> frozenset[str]:
        """Machines without influence on the common ground: excluded, or contradicting all others."""
        contradict = {name for name, verdict in self._audit.verdicts.items() if verdict.contradicts}
        return self._refolding.distrusted() | contradict

    def _machine(self, name: str, sent: dict[str, int]) -> dict[str, Any]:
        decision, verdict = self._refolding.decision(name), self._audit.verdicts.get(name)
        return {
            "name": name,
            "trusted": decision.trusted if decision else True,
            "by": decision.by if decision else "",
            "reason": decision.reason if decision else "",
            "since_ns": decision.stamp_ns if decision else 0,
            "contradicts": bool(verdict and verdict.contradicts),
            "reasons": [str(reason) for reason in verdict.reasons] if verdict else [],
            "evidence": dict(verdict.evidence) if verdict else {},
            **sent,
        }

    def _decision(self, machine: str, trusted: bool | None, reason: str) -> TrustDecision:  # noqa: FBT001
        stamp_ns = self._writer.run(lambda store: store.newest_ns)
        if trusted is None:
            verdict = self._audit.verdicts.get(machine)
            contradicts = bool(verdict and verdict.contradicts)
            return TrustDecision(machine, not contradicts, AUDIT, reason or "left to the audit", stamp_ns)
        return TrustDecision(machine, trusted, PERSON, reason, stamp_ns)

    def _run(self, jobs: Iterable[Job]) -> None:
        while not self._ending.is_set():
            began_s = time.thread_time()
            for job in jobs:
                if self._ending.is_set():
                    break
                try:
                    job.run()
                except (SitegridError, OSError) as error:  # the next turn retries
                    log.error("upkeep failed job=%s error=%r", job.name, str(error))
                except Exception:  # a bug must neither end the server nor go unnoticed
                    log.exception("upkeep failed job=%s", job.name)
            self._ending.wait(pause_s(time.thread_time() - began_s))


def pause_s(worked_s: float) -> float:
    """Pause after a turn of this processor time."""
    return min(max(TURN_S, worked_s * (1 / SHARE - 1)), LATEST_S)
