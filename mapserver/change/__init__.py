"""Where recent evidence contradicts older evidence, and the log of such changes."""
