"""What a drive over the map costs, and which line between two points costs least."""
