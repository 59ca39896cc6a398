"""An Upkeep with all answers and no thread; queries answered like the server's."""

from concurrent.futures import Future
from dataclasses import asdict
from typing import Any

from mapserver.ingest.writer import Writer
from mapserver.query.answering import Answers
from mapserver.query.road_maps import RoadMaps
from mapserver.query.server_source import ServerSource
from mapserver.upkeep.road_repairs import RoadRepairs
from protocol.errors import QueryError, Refusal
from protocol.queries.answers import GroundChange
from protocol.queries.requests import parse_query
from tests.patience import until
from tests.unit.mapserver.data import past_of
from tests.unit.records import machine_state


class FakeUpkeep:
    """An Upkeep of machines a and b that records its calls."""

    def __init__(self) -> None:
        self.asked: list[object] = []

    def machines(self) -> list[dict[str, Any]]:
        return [asdict(machine_state("a")), asdict(machine_state("b", trusted=False))]

    def changes(self, after: int) -> list[GroundChange]:
        self.asked.append(after)
        return [GroundChange(after + 1, 1, 1, (0.0, 0.0, 1.0, 1.0), 4, None, 0.25, None, None)]

    def trust(self, machine: str, trusted: bool | None, reason: str, wait_s: float) -> dict[str, Any]:
        self.asked.append((machine, trusted, reason, wait_s))
        if machine not in "ab":
            raise QueryError(Refusal.UNKNOWN_MACHINE, f"machine `{machine}` is not known")
        return asdict(machine_state(machine, trusted=trusted is not False))


def source_of(writer: Writer, upkeep: FakeUpkeep | None = None) -> ServerSource:
    return ServerSource(writer, upkeep or FakeUpkeep(), past_of(writer))  # type: ignore[arg-type]


class AnswersOf(Answers):
    """Answers that name their subject."""

    def __init__(self, writer: Writer, upkeep: FakeUpkeep | None = None) -> None:
        self.writer, self.source = writer, source_of(writer, upkeep)
        self.roads = RoadMaps(self.source)
        super().__init__(self.source, self.roads)

    def examine_roads(self) -> None:
        """Journal what roads of the newest row and facts show of repairs."""
        self.roads.reach(self.source.run(lambda state: state.version.row))
        self.roads.read()
        RoadRepairs(self.writer, self.roads.repairs).run()


def answers_of(writer: Writer, upkeep: FakeUpkeep | None = None) -> AnswersOf:
    return AnswersOf(writer, upkeep)


def answered(answers: AnswersOf, name: str, parameters: dict[str, str]) -> bytes:
    """Parse a query, wait for its row (default: the newest) and answer."""
    newest = answers.source.run(lambda state: state.version.row)
    if parameters.get("as_of") is None and name in ("segments", "worklist", "route", "way"):
        parameters = {"after": str(newest), **parameters}
    query, waited = parse_query(name, parameters), Future()
    waits = answers.source.waits
    if waits.add(query.after, query.wait_s, waited.set_result):
        until(lambda: waits.time_out() >= 0 and waited.done(), "the row, or the end of the wait")
        if error := waited.result():
            raise error
    return answers.answer(query)
