"""The version of this package."""

from importlib.metadata import PackageNotFoundError, version

UNKNOWN = "unknown"  # run from its sources, without being installed


def package_version() -> str:
    """The installed version, or UNKNOWN."""
    try:
        return version("sitegrid")
    except PackageNotFoundError:
        return UNKNOWN
