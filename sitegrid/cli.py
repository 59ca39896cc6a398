"""The `sitegrid` command: noun first, quiet by default, `--json` for machines.

Exit codes: 0 ok, 1 failed, 2 usage, 130 interrupted. Commands: modules of `sitegrid.commands`.
"""

import os
import signal
import sys
from collections.abc import Sequence


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; errors in one line.

    From here on Ctrl-C ends the process at once. While numpy, Zenoh and others load there is nothing to tidy up, and an
    exception inside them would print a page or get lost. Commands with something to tidy up handle it themselves
    (`stop_flag`, `interruptions`).
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # a shell ignores SIGINT for background jobs
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Linear algebra is small, or in the background of latency-critical work: one core.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is loaded
    from sitegrid.command_line import run
    from sitegrid.process.kernels import drop_stale

    drop_stale()
    return run(sys.argv[1:] if words is None else words)


if __name__ == "__main__":
    sys.exit(main())
