"""From evidence to layers: one function each, NaN where unknown."""
