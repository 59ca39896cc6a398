"""The map server of a site: ingest, journal, fold, read layers, queries, pictures."""
