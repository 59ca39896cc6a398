"""The version of this package, which both sides tell."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

UNKNOWN = "unknown"  # run from its sources, without being installed


def package_version() -> str:
    """As it is installed."""
    try:
        return version("sitegrid")
    except PackageNotFoundError:
        return UNKNOWN
