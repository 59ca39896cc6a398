"""The ground: heights, soil zones, and each soil's effect on wheels."""
