"""Pictures of a scenario: a plan and rendered views."""
