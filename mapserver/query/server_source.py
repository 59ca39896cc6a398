"""The writing process as a source of answers; and commands, which only it obeys."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from mapserver.ingest.writer import Writer
from mapserver.past.past import StorePast
from mapserver.query.source import MapState
from mapserver.upkeep.refolding import write
from mapserver.upkeep.upkeep import Upkeep
from protocol.queries.answers import GroundChange, ServerAlive
from protocol.queries.calibration import CalibrationAnswer
from protocol.queries.commands import AcceptCommand, CalibrateCommand, TrustCommand, parse_command
from protocol.queries.origin import SERVER, Origin
from protocol.queries.request import Request

T = TypeVar("T")


class ServerReading:
    """See `MapReading`."""

    def __init__(self, writer: Writer, past: StorePast) -> None:
        self._writer, self.past = writer, past
        self.site, self.config, self.location = writer.site, writer.config, writer.location

    def run(self, work: Callable[[MapState], T]) -> T:
        """See `Writer.look`."""
        return self._writer.look(work)


class ServerSource(ServerReading):
    """See `MapSource`."""

    def __init__(self, writer: Writer, upkeep: Upkeep, past: StorePast) -> None:
        super().__init__(writer, past)
        self._upkeep, self.waits = upkeep, writer.waits

    def changes(self, after: int) -> list[GroundChange]:
        """See `Upkeep`."""
        return self._upkeep.changes(after)

    def machines(self) -> list[dict[str, Any]]:
        """See `Upkeep`."""
        return self._upkeep.machines()

    def calibration(self) -> CalibrationAnswer:
        """See `Upkeep`."""
        return self._upkeep.calibration()

    def info(self) -> dict[str, Any]:
        """See `Writer`."""
        return self._writer.info()

    def alive(self) -> ServerAlive:
        """See `Writer`."""
        return self._writer.alive()

    def origin(self) -> Origin:
        """The server: a batch is in its map before its acknowledgement."""
        return SERVER

    def count(self, what: str) -> None:
        """See `Writer`."""
        self._writer.count(what)


class CommandDesk:
    """Carries out commands. info: as an answer of `info`."""

    def __init__(self, writer: Writer, upkeep: Upkeep, info: Callable[[], Mapping[str, Any]]) -> None:
        self._writer, self._upkeep, self._info = writer, upkeep, info

    def obey(self, name: str, parameters: Mapping[str, str]) -> bytes:
        """Parse and carry out a command; QueryError if it is wrong."""
        command = parse_command(name, parameters)
        return command.encode(self._obeyed(command))

    def _obeyed(self, command: Request[Any]) -> Any:
        match command:
            case AcceptCommand():
                write(self._writer, lambda store: store.accept(command.store, command.reason))
                return self._info()
            case CalibrateCommand():
                return self._calibrate(command)
            case TrustCommand():
                return self._trust(command)

    def _trust(self, command: TrustCommand) -> dict[str, Any]:
        """The machine's state once the command counts, with the map's version."""
        row = self._upkeep.trust(command.machine, command.trusted, command.reason, command.wait_s)
        version = self._writer.run(lambda store: store.version)
        return {**row, "store": version.store, "merged": version.row, "fact": version.fact}

    def _calibrate(self, command: CalibrateCommand) -> CalibrationAnswer:
        """All machines' calibration once the command counts."""
        if command.machine:
            self._upkeep.correct(command)
        else:
            self._upkeep.calibrate(command.wait_s)
        return self._upkeep.calibration()
