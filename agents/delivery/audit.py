"""The audit file: what an agent recorded, line by line, to compare with the server's journal.

`+ <spool_id> <seq> <hash>`: a recorded sample; a later line replaces it (its final value). `- <spool_id> <seq>`: an
identity made void by renumbering. `? <spool_id> <seq> <hash>`: what a damaged disk held at opening, maybe the value
before the final one; either may be delivered, so both count. Lines follow the commit; opening the spool adds those that
a crash prevented. So every line was on disk once, and lost commits show as a loss.
"""

from collections.abc import Iterable
from pathlib import Path

from protocol.arrays import Table
from protocol.machine.samples import content_hash

Identity = tuple[int, int]  # spool_id, seq
Contents = tuple[str, ...]  # valid hashes of a sample: one, unless a disk was damaged


class AuditLog:
    """Appends to the audit file of one agent."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        self._file = path.open("a", encoding="ascii")

    def recorded(self, spool_id: int, first_seq: int, rows: Table) -> None:
        """Note new samples."""
        self._write(f"+ {spool_id:016x} {first_seq + i} {content_hash(row)}" for i, row in enumerate(rows))

    def renumbered(self, old_id: int, old_seqs: Iterable[int], new_id: int, rows: Table) -> None:
        """Note new identities of samples: 1, 2, 3... of spool `new_id`."""
        self._write(f"- {old_id:016x} {seq}" for seq in old_seqs)
        self.recorded(new_id, 1, rows)

    def complete(self, spooled: Iterable[tuple[int, int, Table]]) -> None:
        """Add lines that a crash prevented or cut off. spooled: samples on disk, as (spool_id, seq, row)."""
        text = self._path.read_text(encoding="ascii")
        if text and not text.endswith("\n"):
            self._write([" # cut off"])
        noted = parse(_whole_lines(text))
        self._write(
            f"{'?' if (spool_id, seq) in noted else '+'} {spool_id:016x} {seq} {content}"
            for spool_id, seq, row in spooled
            if (content := content_hash(row)) not in noted.get((spool_id, seq), ())
        )

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _write(self, lines: Iterable[str]) -> None:
        self._file.writelines(f"{line}\n" for line in lines)
        self._file.flush()


def read_audit(path: Path) -> dict[Identity, Contents]:
    """Valid hashes by identity."""
    return parse(_whole_lines(path.read_text(encoding="ascii")))


def parse(lines: Iterable[str]) -> dict[Identity, Contents]:
    """Hashes by identity; malformed lines are skipped."""
    recorded: dict[Identity, Contents] = {}
    for line in lines:
        match line.split() if "#" not in line else []:
            case ["+", spool_id, seq, content]:
                recorded[int(spool_id, 16), int(seq)] = (content,)
            case ["?", spool_id, seq, content]:
                identity = int(spool_id, 16), int(seq)
                recorded[identity] = (*recorded.get(identity, ()), content)
            case ["-", spool_id, seq]:
                recorded.pop((int(spool_id, 16), int(seq)), None)
    return recorded


def _whole_lines(text: str) -> list[str]:
    return text[: text.rfind("\n") + 1].splitlines()
