"""Which machines contradict all others, and which are excluded from the map."""
