"""Archives that are folded by processes and clusters."""
