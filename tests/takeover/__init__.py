"""Take-overs of a journal in PostgreSQL: real servers, a real database, and a fault in each round."""
