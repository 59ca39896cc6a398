"""`python -m sitegrid`: the command."""

import sys

from sitegrid.cli import main

sys.exit(main())
