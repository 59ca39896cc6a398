"""Map pictures as web map tiles: zoom, column, row."""
