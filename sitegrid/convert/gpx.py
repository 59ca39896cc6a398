"""Tracks of GPS devices and phones: GPX 1.0 and 1.1."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, iterparse

from protocol.errors import LogFolderError
from protocol.units import iso_ns
from sitegrid.convert.recording import Topic, Value


class GpxRecording:
    """Points of all tracks; routes and waypoints are plans."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.topics = [Topic("trkpt", "gpx", {"gps": "lat, lon [deg], ele [m]"}, ("gps",))]
        self.unread: list[str] = []

    def values(self, wanted: Collection[tuple[str, str]]) -> Iterator[Value]:
        """Values of track points; GPX states no variance."""
        for point in _points(self._path) if wanted else ():
            texts = {child.tag.rpartition("}")[2]: (child.text or "").strip() for child in point}
            try:
                place = float(point.get("lat", "")), float(point.get("lon", "")), float(texts.get("ele") or 0)
                yield Value("trkpt", "gps", iso_ns(texts.get("time", "")), (*place, 0.0, 0.0, 0.0))
            except ValueError as error:
                problem = f"its time {error}" if "time" in texts else "no time"
                yield Value("trkpt", "gps", 0, (), problem)


def _points(path: Path) -> Iterator[Element]:
    """Track points, streamed."""
    try:
        for _, element in iterparse(path):  # noqa: S314 - expat from 2.4.1 on stops entities that multiply
            name = element.tag.rpartition("}")[2]
            if name == "trkpt":
                yield element
            if name in ("trkpt", "wpt", "rtept"):
                element.clear()
    except ParseError as error:
        raise LogFolderError(path, f"cannot be read: no whole GPX ({error})") from None
