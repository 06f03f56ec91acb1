"""The console script ``fillerbuster``: from its first moment to its last, Ctrl-C is one line and exit code 130.

`method_configs.commands` takes half a second to import, and the interpreter some time to end: both lie in between here.
"""

from __future__ import annotations

import os
import signal
import sys

from fb_core.machine.interruption import DEBUG_VARIABLE, ENDED_BY_USER, stop_on_signals


def main() -> None:
    """Runs the command that the command line asks for."""
    stop_on_signals()
    try:
        from method_configs.commands import command_line as commands

        commands.main()
    except KeyboardInterrupt:
        if os.environ.get(DEBUG_VARIABLE):
            raise
        sys.stderr.write("Stopped.\n")
        sys.exit(ENDED_BY_USER)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # only Python's own end is left to interrupt


if __name__ == "__main__":
    main()
