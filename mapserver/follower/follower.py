"""The keeper: a thread beside the writer that follows the journal, judges machines, finds changes, archives.

It reads the journal on a connection of its own and never touches the grid: a map without a machine is folded here from
all rows, then handed to the writer, which folds what came in meanwhile and goes on with it.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mapserver.change import change_log
from mapserver.change.detection import reach_blocks
from mapserver.change.validity import around
from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid
from mapserver.evidence.timeline import Block, TimedPage
from mapserver.ingest.store import JOURNAL_FILE, Store
from mapserver.ingest.writer import Writer
from mapserver.journal.archive import FOLDER, archive
from mapserver.journal.history import History, history_rows
from mapserver.journal.reader import JournalReader
from mapserver.journal.rows import Selection
from mapserver.trust.auditor import Auditor, Verdict
from mapserver.trust.decisions import AUDIT, KIND, PERSON, Decision, Decisions
from protocol.errors import QueryError, Refusal, SitegridError
from protocol.site.site_config import SiteConfig

LOOK_BLOCKS = 256  # at a time
ARCHIVE_S = 60.0  # between two looks for rows that are old enough
log = logging.getLogger("mapserver.follower.follower")


class Keeper:
    """What the server finds out about its machines and its ground.

    `machines`, `changes`, `trust` and `distrusted` may be called from any thread. publish: is given each change, as
    plain values, when it is found or grows.
    """

    def __init__(
        self,
        writer: Writer,
        folder: Path,
        site: SiteConfig,
        config: ServerConfig,
        publish: Callable[[dict[str, Any]], None],
        now_ns: Callable[[], int],
    ) -> None:
        self._writer, self._folder, self._site, self._config = writer, folder, site, config
        self._publish, self._now_ns = publish, now_ns
        self._reader = JournalReader(folder / JOURNAL_FILE)
        self._history = History.beside(self._reader)
        self._auditor = Auditor(config.trust, site.cell_m, config.fold)
        self._verdicts: dict[str, Verdict] = {}
        self._decisions = Decisions(self._reader.events(KIND))
        known = [event.body for event in self._reader.events(change_log.KIND)]
        self._watch = change_log.ChangeWatch(site.cell_m, config.change, config.read, known)
        self._followed = self._reader.archived_row
        self._due_s = {"judge": 0.0, "archive": 0.0}
        self._wake, self._ending = threading.Event(), False
        self._asked: list[Decision] = []
        self._state = threading.Condition()
        writer.read(lambda store: store.touch_all())
        self._thread = threading.Thread(target=self._run, name="keeper", daemon=True)
        self._thread.start()

    # --- for any thread ----------------------------------------------------------------------------------------------

    def distrusted(self) -> frozenset[str]:
        """Machines whose rows are left out of the map."""
        return self._writer.read(lambda store: store.left_out)

    def changes(self, after: int = 0) -> list[dict[str, Any]]:
        """Changes of the ground with a number beyond `after`, as plain values."""
        with self._state:
            return [change.values for change in self._watch.changes(after)]

    def machines(self) -> list[dict[str, Any]]:
        """What is known of every machine, as plain values."""
        sent = self._writer.read(lambda store: store.machines())
        with self._state:
            return [self._machine(name, sent[name]) for name in sorted(sent)]

    def trust(self, machine: str, trusted: bool | None, reason: str, wait_s: float) -> dict[str, Any]:  # noqa: FBT001
        """Trust a machine or not, None leaves it to the audit; waits until the map is folded so.

        Returns what `machines` says of it. Raises QueryError where the machine is not known, or after wait_s.
        """
        sent = self._writer.read(lambda store: store.machines())
        if machine not in sent:
            known = ", ".join(sorted(sent)) or "none"
            raise QueryError(Refusal.UNKNOWN_MACHINE, f"machine `{machine[:40]}` has sent nothing; known: {known}")
        decision = self._asked_for(machine, trusted, reason)
        with self._state:
            self._asked.append(decision)
            self._wake.set()
            done = self._state.wait_for(lambda: decision not in self._asked, wait_s)
        if not done:
            raise QueryError(
                Refusal.AFTER_TIMEOUT, f"the map is not folded again after {wait_s:g} s; ask for `machines`"
            )
        return next(row for row in self.machines() if row["name"] == machine)

    def close(self) -> None:
        """End the thread."""
        self._ending = True
        self._wake.set()
        self._thread.join()
        self._reader.close()

    def _machine(self, name: str, sent: dict[str, int]) -> dict[str, Any]:
        decision, verdict = self._decisions.of(name), self._verdicts.get(name)
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

    def _asked_for(self, machine: str, trusted: bool | None, reason: str) -> Decision:  # noqa: FBT001
        stamp_ns = self._writer.read(lambda store: store.newest_ns)
        if trusted is None:
            verdict = self._verdicts.get(machine)
            contradicts = bool(verdict and verdict.contradicts)
            return Decision(machine, not contradicts, AUDIT, reason or "left to the audit", stamp_ns)
        return Decision(machine, trusted, PERSON, reason, stamp_ns)

    # --- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        keep = self._config.keep
        while not self._ending:
            for work in (self._follow, self._judge, self._decide, self._look, self._archive):
                if self._ending:
                    break
                try:
                    work()
                except (SitegridError, OSError) as error:  # the map goes on without; the next turn tries again
                    log.error("keeper failed work=%s error=%r", work.__name__.strip("_"), str(error))
                except Exception:  # a bug here must not end the server, nor pass unseen
                    log.exception("keeper failed work=%s", work.__name__.strip("_"))
            self._wake.wait(keep.turn_s)
            self._wake.clear()

    def _follow(self) -> None:
        """Hand new journal rows to the audit; a piece at a time, so that commands need not wait."""
        until = self._reader.last_row  # what comes in meanwhile waits for the next turn, or a busy site would have none
        for row in self._reader.read(after=max(self._followed, self._reader.archived_row), until=until):
            self._auditor.add(row.machine, row.rows)
            self._followed = row.row
            if self._ending or self._asked:
                return

    def _judge(self) -> None:
        """Judge all machines from time to time, and decide on it where the audit may."""
        if not self._is_due("judge", self._config.keep.judge_s):
            return
        verdicts = self._auditor.verdicts()
        stamp_ns = self._writer.read(lambda store: store.newest_ns)
        with self._state:
            self._verdicts = verdicts
            if self._config.keep.distrusts:
                self._asked += self._decisions.judge(verdicts, stamp_ns)

    def _decide(self) -> None:
        """Let what was decided count: keep it, fold the map again if it changes who is left out, answer."""
        with self._state:
            asked = list(self._asked)
        if not asked:
            return
        for decision in asked:
            self._remember(KIND, decision.stamp_ns, decision.body)
            log.warning("trust machine=%s trusted=%s by=%s reason=%r", *_told(decision))
            with self._state:
                self._decisions.take(decision)
        if self._decisions.distrusted != self.distrusted():
            self._fold_again(self._decisions.distrusted)
        with self._state:
            self._asked = [decision for decision in self._asked if decision not in asked]
            self._state.notify_all()

    def _fold_again(self, left_out: frozenset[str]) -> None:
        """Fold the whole history without some machines, and have the writer go on with that."""
        until = self._reader.last_row
        grid = Grid(self._site.cell_m, self._config.fold)
        for row in history_rows(self._history, until=until, selection=Selection(without=left_out)):
            grid.fold(row.rows, row.machine)
            if self._ending:
                return
        self._writer.read(lambda store: store.adopt(grid, until, left_out))

    def _look(self) -> None:
        """Look for changes where something was folded since the last look."""
        reach = reach_blocks(self._site.cell_m, self._config.change)
        while not self._ending:
            blocks, pages = self._writer.read(lambda store: _touched(store, reach))
            if not blocks:
                return
            with self._state:
                found = self._watch.look(blocks, pages)
            for change in found:
                self._remember(change_log.KIND, change.last_ns, change.values)
                self._publish(change.values)

    def _archive(self) -> None:
        """Move the next hour of old rows to the archive; an hour a turn, so that the end need not wait."""
        keep = self._config.keep
        if not keep.archive_after_h or not self._is_due("archive", ARCHIVE_S):
            return
        before_ns = self._now_ns() - round(keep.archive_after_h * 3600e9)
        hours = archive(self._folder / FOLDER, self._reader, self._site, before_ns, self._forget)
        if (path := next(hours, None)) is None:
            return
        self._writer.read(lambda store: store.shrink())
        log.info("archived file=%s", path.name)
        self._due_s["archive"] = 0.0  # there may be more hours

    def _remember(self, kind: str, stamp_ns: int, body: dict[str, Any]) -> None:
        self._writer.read(lambda store: store.remember(kind, stamp_ns, body))

    def _forget(self, until: int) -> int:
        if self._ending:  # what is in both meanwhile counts once, and the next start goes on with it
            return until
        return self._writer.read(lambda store: store.forget(until))

    def _is_due(self, work: str, every_s: float) -> bool:
        now_s = time.monotonic()
        if now_s < self._due_s[work]:
            return False
        self._due_s[work] = now_s + every_s
        return True


def _touched(store: Store, reach: int) -> tuple[list[Block], dict[Block, list[TimedPage]]]:
    """Some of the blocks in which something was folded since they were looked at, and pages of them and around."""
    blocks = store.grid.take_touched(LOOK_BLOCKS)
    wide = sorted({near for block in blocks for near in around(block, reach)})
    return blocks, {block: pages for block, pages in zip(wide, store.grid.pages(wide), strict=True) if pages}


def _told(decision: Decision) -> tuple[str, bool, str, str]:
    return decision.machine, decision.trusted, decision.by, decision.reason
