"""`python -m lab`: the experiments behind the project's figures."""

import sys

from lab import commands
from sitegrid.command_line import run

if __name__ == "__main__":
    sys.exit(run(sys.argv[1:], commands, "python -m lab"))
