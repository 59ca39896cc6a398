"""From evidence to what a reader asks for: one function per layer, NaN where unknown."""
