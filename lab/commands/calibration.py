"""`python -m lab calibration`: machines that calibrate each other."""

from functools import partial

from lab.campaign.command import add_runs, seeded

HELP = "measure what calibration of machines by each other and by the ground gives the map"
EXTRA = "lab"
add_options = partial(add_runs, seconds=900.0)
run = seeded("lab.calibration.experiment", "machines drive, and are calibrated by the ground")
