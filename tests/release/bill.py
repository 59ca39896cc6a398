"""`python -m tests.release.bill > bill.json`: what this Python's environment has, as a CycloneDX bill of materials."""

from __future__ import annotations

import json
import sys
from importlib.metadata import Distribution, distributions
from typing import Any


def main() -> None:
    """Print it; the same environment gives the same bytes."""
    parts = {part["purl"]: part for part in map(component, distributions())}
    bill = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "components": [parts[at] for at in sorted(parts)],
    }
    print(json.dumps(bill, indent=1))


def component(one: Distribution) -> dict[str, Any]:
    """A package with its licence, as its author states it: an expression of SPDX, else a name."""
    meta = one.metadata
    name = meta["Name"].lower().replace("_", "-")
    expression, free = meta["License-Expression"], (meta["License"] or "").strip().splitlines()
    named = [line.rsplit(" :: ", 1)[-1] for line in meta.get_all("Classifier", []) if line.startswith("License ::")]
    licences = [{"license": {"name": text}} for text in named or free[:1]]
    return {
        "type": "library",
        "name": meta["Name"],
        "version": one.version,
        "purl": f"pkg:pypi/{name}@{one.version}",
        "licenses": [{"expression": expression}] if expression else licences,
    }


if __name__ == "__main__":
    sys.exit(main())
