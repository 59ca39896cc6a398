"""Take-overs of a PostgreSQL journal: real servers and database, a fault per round."""
