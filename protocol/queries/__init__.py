"""Map queries and commands, with their answers."""
