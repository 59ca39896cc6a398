"""Styles of layers as QGIS reads them (QML): what is shown is what the page and the pictures show."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from protocol.site.ground_classes import ZONES

BAD, DONE, DARK = (200, 30, 30), (30, 90, 200), (60, 60, 60)  # red, green, blue
LINES = {"worklist": (BAD, 1.4), "repairs": (DONE, 1.4), "tracks": (DARK, 0.2)}  # colour, width in mm
Colour = tuple[int, int, int]


def style_of(layer: str, boundaries: Sequence[float]) -> str:
    """The style of a layer. boundaries: of the classes of resistance."""
    if layer == "zones":
        rows = [(f"value='{kind}'", name, _fill(colour)) for kind, (name, colour) in enumerate(_classes(boundaries))]
        return _qml("categorizedSymbol", "class", "categories", "category", rows)
    if layer == "segments":
        ends = [0.0, *boundaries, 1.0]
        classes = zip(ends, ends[1:], _classes(boundaries), strict=False)
        ranges = [(f"lower='{low}' upper='{high}'", name, _line(colour, 0.9)) for low, high, (name, colour) in classes]
        return _qml("graduatedSymbol", "resistance", "ranges", "range", ranges)
    symbol = _line(*LINES[layer]) if layer in LINES else _outline(BAD)
    return _qml("singleSymbol", "", "", "", [("", "", symbol)])


def _classes(boundaries: Sequence[float]) -> list[tuple[str, Colour]]:
    """Names and colours of the classes of ground; a site with others than the usual has numbers for names."""
    usual = len(boundaries) + 1 == len(ZONES)
    zones = [ZONES[kind % len(ZONES)] for kind in range(len(boundaries) + 1)]
    return [(zone.name if usual else str(kind), zone.bgr[::-1]) for kind, zone in enumerate(zones)]


def _qml(kind: str, attribute: str, plural: str, single: str, rows: Iterable[tuple[str, str, str]]) -> str:
    """A renderer: for each row what it is of, its label, its symbol."""
    known = list(enumerate(rows))
    parts = [f"<{single} {what} symbol='{i}' label='{escape(name)}' render='true'/>" for i, (what, name, _) in known]
    listed = f"<{plural}>{''.join(parts)}</{plural}>" if plural else ""
    symbols = "".join(symbol.format(name=i) for i, (_, _, symbol) in known)
    head = f"<renderer-v2 type='{kind}' attr='{attribute}' symbollevels='0' enableorderby='0'>"
    return f"<qgis styleCategories='Symbology'>{head}{listed}<symbols>{symbols}</symbols></renderer-v2></qgis>"


def _fill(colour: Colour) -> str:
    return _symbol("fill", "SimpleFill", color=_text(colour, 170), style="solid", outline_style="no")


def _outline(colour: Colour) -> str:
    return _symbol("fill", "SimpleFill", style="no", outline_color=_text(colour, 255), outline_width="0.6")


def _line(colour: Colour, width_mm: float) -> str:
    return _symbol("line", "SimpleLine", line_color=_text(colour, 255), line_width=str(width_mm))


def _text(colour: Colour, alpha: int) -> str:
    return ",".join(map(str, (*colour, alpha)))


def _symbol(kind: str, layer: str, **options: str) -> str:
    """A symbol, whose name is still open."""
    listed = "".join(f"<Option type='QString' name='{name}' value='{value}'/>" for name, value in options.items())
    inner = f"<layer class='{layer}' enabled='1' pass='0' locked='0'><Option type='Map'>{listed}</Option></layer>"
    return f"<symbol type='{kind}' name='{{name}}' alpha='1' clip_to_extent='1' force_rhr='0'>{inner}</symbol>"
