"""Where recent evidence contradicts older evidence, and the list of changes found so."""
