"""From a batch's bytes to journal and grid: admission, the store, and its thread."""
