"""What programs in a terminal share: arguments, bars, text, signals."""
