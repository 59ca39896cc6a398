"""The map's HTTP feed: the live page, the resources of an API, tiles and features for other tools."""
