"""What was measured of one of a kind, and what is assumed: all that the sums of docs/scaling.md are made of."""

from __future__ import annotations

from dataclasses import dataclass

SIZES = "python -m lab.speed sizes --seconds 600 --json"
FLEET = "python -m lab.speed fleet --machines 500 --json"
INGEST = "python -m lab.speed ingest --runs 3 --json"
FOLLOW = "python -m lab.speed follow --seconds 8 --runs 3 --json"
FOLD = "python -m lab.speed fold --json"
MEMORY = "python -m lab.speed memory"
EVAL = "sitegrid eval fleet"
FILTER = "python -m lab.speed filter"
OWN = "scaling.md"


@dataclass(frozen=True)
class Measured:
    """A figure. page: of docs/results, where it stands as `shown`; command: what prints it."""

    what: str
    value: float
    unit: str
    shown: str
    page: str
    command: str


@dataclass(frozen=True)
class Assumed:
    """A figure that nobody measured: change it for your sites."""

    what: str
    value: float
    unit: str


RATE = Measured("samples of a machine that drives all the time", 6.52, "1/s", "6.52", OWN, SIZES)
UP = Measured("its link, up, while somebody listens to its pose", 2583.2, "B/s", "2583.2", OWN, SIZES)
DOWN = Measured("the same, down", 240.7, "B/s", "240.7", OWN, SIZES)
ARCHIVE = Measured("archive", 45.0, "B/sample", "45.0", OWN, SIZES)
JOURNAL = Measured("journal in SQLite, batches of 3", 121.0, "B/sample", "121.0", OWN, SIZES)
POSTGRES = Measured("journal in PostgreSQL, batches of 3", 160.6, "B/sample", "160.6", OWN, SIZES)
AGENT = Measured("agent", 0.91, "% of a core", "0.91 % of a core", "localisation.md", FILTER)
AGENT_MB = Measured("agent, memory", 116.6, "MB", "116.6 MB", "localisation.md", FILTER)
ROUTER = Measured("router, 500 machines with a batch a second each", 0.098, "cores", "0.098", OWN, FLEET)
ROUTER_MB = Measured("the same, memory", 60, "MB", "60", OWN, FLEET)
SERVER_MB = Measured("map server, 500 machines, memory", 539, "MB", "539", OWN, FLEET)
TAKEN = Measured(
    "map server that is offered all it takes, 500 machines", 48_352, "samples/s", "48 352", "ingest.md", FLEET
)
TAKEN_CORES = Measured("the same", 1.02, "cores", "1.02", "ingest.md", FLEET)
MACHINES = Measured("machines at one map server, with all its upkeep", 500, "", "500 machines", "ingest.md", FLEET)
IN_POSTGRES = Measured("journal in PostgreSQL", 0.64, "of SQLite", "0.64;", "ingest.md", INGEST)
REPLICATED = Measured("with a synchronous replica on the same disk", 0.59, "of SQLite", "0.59;", "ingest.md", INGEST)
ANSWERS = Measured("two followers, 50 readers", 100, "answers/s", "| 100 |", "followers.md", FOLLOW)
FOLLOWER_CORES = Measured("the same", 0.23, "cores", "0.23", "followers.md", FOLLOW)
FOLDED = Measured("fold of a journal", 0.70e6, "samples/s of a core", "0.70", "refold.md", FOLD)
CELL = Measured(
    "evidence in memory and snapshot", 50, "B per driven cell and bucket", "**50 bytes**", "merge.md", MEMORY
)
SOLVE = Measured(
    "calibration of ten machines, a day remembered", 2.3, "s of a core", "2.3 s", "fleet-calibration.md", EVAL
)

MEASURED = tuple(each for each in vars().copy().values() if isinstance(each, Measured))

DRIVES = Assumed("share of a working day that a machine drives", 0.4, "")
HOURS = Assumed("working day", 10, "h")
DAYS = Assumed("working days", 300, "a year")
HEADROOM = Assumed("share of what a server takes that a site may need", 0.5, "")
ROUTED = Assumed("machines at one router", 500, "")
HOST = Assumed("host with 4 cores, 8 GB and its power", 50, "EUR a month")
DISK = Assumed("disk, kept twice", 0.10, "EUR a GB and month")
SIM_CARD = Assumed("SIM card of a machine", 5, "EUR a month")
TRAFFIC = Assumed("traffic of a machine beyond that", 1.0, "EUR a GB")

ASSUMED = tuple(each for each in vars().copy().values() if isinstance(each, Assumed))
