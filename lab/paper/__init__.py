"""The paper repeated: its tables and maps, and what this project makes of the same drives."""
