"""Faults between bus and reader, seeded, and what became of every frame. No I/O, no clock.

A fault works on frames (`frames`), on the bytes of their lines (`lines`), or on the link itself; `stretches` says when,
`injector` runs them, and `truth` keeps what a reader must have got, lost and counted.
"""
