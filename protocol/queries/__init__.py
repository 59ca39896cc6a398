"""Map queries and commands: what is asked, and what is answered."""
