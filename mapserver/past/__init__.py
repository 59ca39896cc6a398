"""The past: checkpoints of evidence, maps as of any time, and the history of a point."""
