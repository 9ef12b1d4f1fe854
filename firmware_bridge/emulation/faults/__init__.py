"""Seeded faults between bus and reader, and the fate of every frame. No I/O, no clock.

A fault works on frames (`frames`), on the bytes of their lines (`lines`), or on the link itself; `stretches` parses the
fault intervals, `injector` applies them, and `truth` counts what a reader must have received, lost and counted.
"""
