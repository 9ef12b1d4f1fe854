"""Conditions that hold in every test."""

import signal

# A shell ignores Ctrl-C in what it starts in the background, and programs that a test interrupts would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
