"""`python -m lab roads`: roads and their losses."""

from functools import partial

from lab.campaign.command import add_runs, seeded

HELP = "measure roads, traffic, losses and repairs on random patches of soil"
EXTRA = "lab"
add_options = partial(add_runs, seconds=900.0, cases=True)
run = seeded("lab.roads.experiment", "machines drive on patches of soil, their samples show roads")
