"""`edge-sr` as a program: until what it does listens for Ctrl-C, that ends it at once and without a traceback."""

import signal
import sys

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else whoever started it wants it ignored
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from edge.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
