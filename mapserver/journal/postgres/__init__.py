"""The journal in a PostgreSQL database, for standby servers or many readers."""

MARK_FILE = "journal-mark"  # file name in a server's folder, beside snapshots
