"""The `sitegrid` command: noun first, quiet by default, `--json` for machines.

Exit codes: 0 ok, 1 failed, 2 usage, 130 interrupted. The commands are the modules of `sitegrid.commands`.
"""

import os
import signal
import sys
from collections.abc import Sequence


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; errors in one line.

    Ctrl-C ends the process at once, from here on: while numpy, Zenoh and others are loaded there is nothing to tidy up,
    and an exception in the middle of their code would be a page of text, or be lost. A command that has something to
    tidy up says so (`stop_flag`, `interruptions`).
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not where a shell ignores it in background
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Linear algebra here is small, or in the background of something that must not wait: it gets no more than one core.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is loaded
    from sitegrid.command_line import run
    from sitegrid.process.kernels import drop_stale

    drop_stale()
    return run(sys.argv[1:] if words is None else words)


if __name__ == "__main__":
    sys.exit(main())
