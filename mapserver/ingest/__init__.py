"""From a batch's bytes to the journal and the grid: admission, the store, and the thread that owns it."""
