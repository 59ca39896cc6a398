"""`python -m lab`: the experiments behind the project's figures."""

import sys

from lab import commands
from sitegrid.door import run

if __name__ == "__main__":
    sys.exit(run(sys.argv[1:], commands, "python -m lab"))
