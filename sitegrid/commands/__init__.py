"""Many machines draw one map of the ground together.

One module per command of `sitegrid`: `HELP`, `add_options(parser)`, and `run(arguments)`, the exit code. At its top it
imports the base install only, extras inside functions: `--help` is quick and works in any install.
"""

# In the order of `sitegrid --help`, each command once.
GROUPS = {
    "run a site": ("router", "server", "agent", "corrections", "web", "sim", "follow", "demo"),
    "ask": ("query", "calibrate", "trust", "distrust"),
    "look": ("plot", "log", "export", "record", "replay"),
    "keep": ("backup", "restore", "verify", "accept", "fold"),
    "set up": ("probe", "init", "up", "doctor", "keys"),
}
