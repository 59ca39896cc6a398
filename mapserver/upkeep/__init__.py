"""Background jobs beside the writer: audit, exclusion, changes, archiving."""
