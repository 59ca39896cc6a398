"""The package version."""

from importlib.metadata import PackageNotFoundError, version

UNKNOWN = "unknown"  # not installed


def package_version() -> str:
    """Installed version, or UNKNOWN."""
    try:
        return version("sitegrid")
    except PackageNotFoundError:
        return UNKNOWN
