"""PostgreSQL servers for benchmarks and tests, and what a journal on them costs."""
