"""Pictures of the map for the commands `plot` and `demo`: what is asked for, and how it is laid out."""
