"""Levels and cycles of modules that import each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache


def layering(imports: Mapping[str, Iterable[str]]) -> tuple[int, int]:
    """Number of levels, a cycle counting as one, and number of cycles."""
    known = {name: sorted(imported for imported in those if imported in imports) for name, those in imports.items()}
    circles = _circles(known)
    circle_of = {name: number for number, circle in enumerate(circles) for name in circle}

    @cache
    def level(circle: int) -> int:
        below = {circle_of[imported] for name in circles[circle] for imported in known[name]} - {circle}
        return 1 + max(map(level, below), default=0)

    return max(map(level, range(len(circles))), default=0), sum(len(circle) > 1 for circle in circles)


def _circles(edges: Mapping[str, Sequence[str]]) -> list[list[str]]:
    """Strongly connected components, lowest first (Tarjan 1972)."""
    order: dict[str, int] = {}
    lowest: dict[str, int] = {}
    stack: list[str] = []
    components: list[list[str]] = []

    def visit(name: str) -> None:
        order[name] = lowest[name] = len(order)
        stack.append(name)
        for other in edges[name]:
            if other not in order:
                visit(other)
            if other in stack:
                lowest[name] = min(lowest[name], lowest[other])
        if lowest[name] == order[name]:
            cut = stack.index(name)
            components.append(stack[cut:])
            del stack[cut:]

    for name in edges:
        if name not in order:
            visit(name)
    return components
