"""What an agent's health says of its sensors; of another version, its values may be anything."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

MOST_FAULTS, MOST_CHARS = 10, 200  # of what is shown of one machine


def faults_of(values: Mapping[str, Any]) -> list[str]:
    """Sentences on sensors that do not count or contradict others, with the sensors' names."""
    pipeline = values.get("pipeline")
    faults = pipeline.get("faults") if isinstance(pipeline, Mapping) else None
    named = list(faults.items())[:MOST_FAULTS] if isinstance(faults, Mapping) else []
    return [f"{name} {fault}"[:MOST_CHARS] for name, fault in named]
