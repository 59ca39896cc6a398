"""What goes on beside the map: the journal followed, machines judged, changes found, old rows archived."""
