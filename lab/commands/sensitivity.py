"""`python -m lab sensitivity`: which constants matter."""

from functools import partial

from lab.campaign.command import add_runs, seeded

HELP = "vary each constant of the ground's estimators by 30 %, and see which figures move"
EXTRA = "lab"
add_options = partial(add_runs, seconds=600.0)
run = seeded("lab.ground.sensitivity", "loaders work, estimators with other constants follow")
