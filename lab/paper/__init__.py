"""The paper repeated: its tables and maps, and ours of the same drives."""
