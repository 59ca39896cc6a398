"""Pictures of the map in tiles as web maps have them: zoom, column, row."""
