"""Common parts of programs in a terminal: arguments, bars, text, signals."""
