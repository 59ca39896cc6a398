"""`python -m lab fedback`: what lanes are worth that are fed back, and where they may harm."""

from functools import partial

from lab.campaign.command import add_runs, seeded

HELP = "filter drives again with the lanes of another day, at a thirtieth of the cost"
EXTRA = "lab"
add_options = partial(add_runs, seconds=420.0, cases=True)
run = seeded("lab.fedback.experiment", "machines drive two days, the second on the lanes of the first")
