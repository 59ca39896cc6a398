"""`python -m lab routes`: routes and ways."""

from functools import partial

from lab.campaign.command import add_runs, seeded

HELP = "compare routes with what machines spent, and ways with a finer search"
EXTRA = "lab"
add_options = partial(add_runs, seconds=900.0, cases=True)
run = seeded("lab.routes.experiment", "machines drive on patches of soil, their samples price routes")
