"""`python -m lab ground`: accuracy of ground estimation."""

from functools import partial

from lab.campaign.command import add_runs, seeded

HELP = "measure the accuracy of rolling resistance and gradient of loaders at work"
EXTRA = "lab"
add_options = partial(add_runs, seconds=600.0)
run = seeded("lab.ground.experiment", "loaders work, estimators follow")
