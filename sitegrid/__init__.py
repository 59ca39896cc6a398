"""sitegrid: many machines on a construction site draw one map of the ground together.

Ask the map server of a site::

    with sitegrid.connect("tcp/127.0.0.1:7447", "paper") as site:
        ground = site.region((0, 0, 200, 150), ["resistance"])
"""

TYPE_CHECKING = False  # like `typing.TYPE_CHECKING`, without importing `typing`
if TYPE_CHECKING:
    from sitegrid.api import *  # noqa: F403 - it has __all__
    from sitegrid.api import __version__ as __version__


def __getattr__(name: str) -> object:
    """Import on demand: the command starts here too, and must handle Ctrl-C before numpy is loaded."""
    from importlib import import_module

    api = import_module("sitegrid.api")
    if not hasattr(api, name):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(api, name)


def __dir__() -> list[str]:
    return [*globals(), *__getattr__("__all__")]  # type: ignore[misc]
