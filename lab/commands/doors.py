"""`python -m lab doors`: the same drives by bundles and by receiver bytes."""

from functools import partial

from lab.campaign.command import add_runs, seeded

HELP = "compare positions and maps of drives by bundles with those by the bytes of receivers"
EXTRA = "lab"
add_options = partial(add_runs, seconds=600.0)
run = seeded("lab.calibration.doors", "machines drive, receivers speak")
