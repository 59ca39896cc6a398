"""A scenario as a person sees it: a plan from above and rendered views."""
