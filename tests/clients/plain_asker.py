"""An independent reader of map answers, written from docs/protocol.md alone, without this project's code."""

from __future__ import annotations

import struct
import time
import zlib
from typing import Any

import msgpack

PAUSE_S = 0.1
Layers = dict[str, list[list[float]]]  # rows from the south, each from west to east


class RefusedError(Exception):
    """The server refuses the query."""


def ask(session: Any, site: str, query: str, within_s: float = 10.0, **parameters: object) -> dict[str, Any]:
    """One answer; retried if none comes, and where refusals allow it."""
    selector = f"sitegrid/{site}/map/{query}"
    if parameters:
        selector += "?" + ";".join(f"{name}={value}" for name, value in parameters.items())
    end_s = time.monotonic() + within_s
    while (left_s := end_s - time.monotonic()) > 0:
        pause_s = PAUSE_S
        for reply in session.get(selector, timeout=left_s):
            if reply.ok is not None:
                answer: dict[str, Any] = msgpack.unpackb(reply.ok.payload.to_bytes())
                if answer["v"] != 1:
                    raise RefusedError("another version")
                return answer
            if (text := reply.err.payload.to_bytes()) != b"Timeout":
                refusal = msgpack.unpackb(text)
                pause_s = refusal.get("retry_after_s", 0.0)
                if not pause_s:
                    raise RefusedError(refusal["reason"])
        time.sleep(pause_s)
    raise TimeoutError(selector)


def region(
    session: Any, site: str, bounds: tuple[float, float, float, float], *layers: str
) -> tuple[dict[str, Any], Layers]:
    """A rectangle, assembled from pieces: its first answer, and all layers."""
    sides = ",".join(map(repr, bounds))
    first = answer = ask(session, site, "region", bounds=sides, **({"layers": ",".join(layers)} if layers else {}))
    piece = first.get("piece")
    if not piece:
        return first, {name: _rows(first, name) for name in first["layers"]}
    whole: Layers = {
        name: [[float("nan")] * piece["columns"] for _ in range(piece["rows"])] for name in first["layers"]
    }
    for number in range(piece["count"]):
        if number:
            answer = ask(session, site, "piece", cursor=piece["cursor"], number=number)
        at = answer["piece"]
        assert (at["number"], answer["store"], answer["merged"]) == (number, first["store"], first["merged"])
        for name in answer["layers"]:
            for i, row in enumerate(_rows(answer, name)):
                whole[name][at["row"] + i][at["column"] : at["column"] + answer["columns"]] = row
    return first, whole


def slopes(answer: dict[str, Any]) -> dict[tuple[int, int], tuple[float, float]]:
    """Gradient east and north of an answer of `lanes`, by column and row of 4 x 4 cells, where it is known."""
    x, y = (struct.unpack(f"<{answer['n']}q", answer["cols"][name]) for name in ("x", "y"))
    steps = struct.unpack(f"{32 * answer['n']}b", zlib.decompress(answer["slopes"]))
    out = {}
    for square, at in enumerate(zip(x, y, strict=True)):
        for part in range(16):
            east, north = steps[32 * square + part], steps[32 * square + 16 + part]
            if east != -128:
                out[4 * at[0] + part % 4, 4 * at[1] + part // 4] = 0.002 * east, 0.002 * north
    return out


def _rows(answer: dict[str, Any], name: str) -> list[list[float]]:
    columns, rows = answer["columns"], answer["rows"]
    values = struct.unpack(f"<{columns * rows}f", answer["layers"][name])
    return [list(values[i * columns : (i + 1) * columns]) for i in range(rows)]
