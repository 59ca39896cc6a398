"""The fault suite: real processes, real faults, and a count of what was lost or came twice (docs/guarantees.md)."""
