"""`python -m lab can`: torque and fuel by a machine's bus."""

from functools import partial

from lab.campaign.command import add_runs, seeded

HELP = "measure what torque by a machine's bus costs the map, and check its litres"
EXTRA = "lab"
add_options = partial(add_runs, seconds=900.0, cases=True)
run = seeded("lab.can.experiment", "machines on buses drive on patches of soil")
