from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest

from sitegrid.web.site import HEARD_S, SiteFeed


def test_nobody_waits_for_machines_once_the_site_was_listened_to_for_long_enough():
    async def ask() -> None:
        feed = SiteFeed(SimpleNamespace(site="pit"))
        feed._listens_s = asyncio.get_running_loop().time() - HEARD_S
        with pytest.raises(StopIteration):  # ends without waiting
            feed.heard().send(None)

    asyncio.run(ask())


def test_pages_that_watch_are_counted(monkeypatch: pytest.MonkeyPatch):
    async def follow(feed: SiteFeed) -> None: ...

    async def watch() -> list[int]:
        feed, counts = SiteFeed(SimpleNamespace(site="pit")), []
        async with feed.watched():
            async with feed.watched():
                counts.append(feed.watchers)
            counts.append(feed.watchers)
        return [*counts, feed.watchers]

    monkeypatch.setattr(SiteFeed, "_follow", follow)
    assert asyncio.run(watch()) == [2, 1, 0]
