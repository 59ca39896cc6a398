"""sitegrid: many machines on a construction site draw one map of the ground together."""

from sitegrid.client import Client, connect

__all__ = ["Client", "connect"]
