"""`edge-sr` as a program; Ctrl-C ends it at once and without a traceback until the command handles it itself."""

import signal
import sys

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else the parent process wants it ignored
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from edge.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
