"""Options that commands share, and the values that options take."""
