"""The map fed back: benefit of localisation on the fleet's lanes, and possible harm."""
