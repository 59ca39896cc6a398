"""Whether a running agent's positions hold, by its own health: what its fixes confirm, refute, or cannot show."""

from collections.abc import Mapping
from typing import Any

from sitegrid.doctor import Finding, Level, skipped

REFUTED = "fixes are further off than the filter expects: look at the variance that the receiver states, and at mounts"
UNSEEN = "a slow GPS error that is larger than stated would not show: there is one receiver, or several that err alike"


def check_positions(machine: str, values: Mapping[str, Any]) -> Finding:
    """The verdicts on an agent's receivers, by the values of its health report: they may be anything."""
    pipeline = values.get("pipeline")
    receivers = pipeline.get("consistency") if isinstance(pipeline, Mapping) else None
    verdicts = {
        str(name): each.get("verdict")
        for name, each in (receivers.items() if isinstance(receivers, Mapping) else ())
        if isinstance(each, Mapping)
    }
    if not verdicts:
        return skipped("positions", f"{machine} has had too few fixes")
    named = ", ".join(f"{name} {str(verdict).replace('_', ' ')}" for name, verdict in sorted(verdicts.items()))
    if "inconsistent" in verdicts.values():
        return Finding(Level.WARN, "positions", f"{machine}: {named}", REFUTED)
    unseen = f"; {UNSEEN}" if "consistent" not in verdicts.values() else ""
    return Finding(Level.PASS, "positions", f"{machine}: {named}{unseen}", "")
