"""The map's HTTP door: the live page, the resources of an API, tiles and features for other tools."""
