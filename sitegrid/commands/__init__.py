"""Many machines draw one map of the ground together.

The commands of `sitegrid`, one module each: `HELP`, `add_options(parser)` and `run(arguments)`, the exit code.

A command module imports at its top only what the base install has. What needs an extra is imported inside a function,
so that every command describes itself in any install, and `sitegrid --help` is quick.
"""

# In the order of `sitegrid --help`: each command once.
GROUPS = {
    "run a site": ("router", "server", "agent", "corrections", "web", "sim", "follow", "demo"),
    "ask": ("query", "calibrate", "trust", "distrust"),
    "look": ("plot", "log", "export", "record", "replay"),
    "keep": ("backup", "restore", "verify", "accept", "fold"),
    "set up": ("probe", "init", "up", "doctor", "keys"),
}
