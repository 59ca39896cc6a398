"""Which machines contradict all others, and whose samples are left out of the map."""
