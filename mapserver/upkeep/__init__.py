"""Jobs that follow the journal and the grid beside the writer: audit, exclusion, changes, archiving."""
