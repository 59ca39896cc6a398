"""The site's now by what machines sent lately: a clock that is wrong counts while it is wrong, and not a day longer."""

from __future__ import annotations

from collections.abc import Collection

RECENT = 10  # marks; a machine that was silent for longer says nothing of now, though its clock may have been ahead


class SiteClock:
    """Site time for a job that looks now and then, which is marked each time.

    A machine is as far as what came in of it last, so that it falls back with the machine's clock.
    """

    def __init__(self) -> None:
        self._marks = 0
        self._last_ns: dict[str, int] = {}  # by machine, of what came in last
        self._since: dict[str, int] = {}  # by machine, behind which mark that came in
        self._marked_ns: dict[str, int] = {}  # by machine, its last at the last mark, or its first stamp of all

    def add(self, machine: str, oldest_ns: int, last_ns: int) -> None:
        """Take samples of a machine into account, by the oldest stamp and that of what came in last."""
        self._marked_ns.setdefault(machine, oldest_ns)
        self._last_ns[machine], self._since[machine] = last_ns, self._marks

    def now_ns(self, without: Collection[str] = ()) -> int:
        """The newest stamp of all machines but some [ns], of those that sent anything of late; 0 for none."""
        since = {name: mark for name, mark in self._since.items() if name not in without} or self._since
        last = max(since.values(), default=0)
        return max((self._last_ns[name] for name, mark in since.items() if mark > last - RECENT), default=0)

    def passed_ns(self, without: Collection[str] = ()) -> int:
        """Site time since the last mark [ns], by the machine that went on furthest, or was set back."""
        names = (name for name, mark in self._since.items() if mark == self._marks and name not in without)
        return max((abs(self._last_ns[name] - self._marked_ns[name]) for name in names), default=0)

    def mark(self) -> None:
        """Begin to count anew what has passed."""
        self._marked_ns |= self._last_ns
        self._marks += 1
