"""The past: checkpoints of the evidence, maps as of any time made from them, and the history of a point."""
