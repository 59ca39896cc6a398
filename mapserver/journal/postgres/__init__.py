"""The journal in a PostgreSQL database, for sites whose map server must not be down or that many read."""

MARK_FILE = "journal-mark"  # in the folder of a server, beside its snapshots
