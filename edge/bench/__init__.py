"""Error against run time: every model and every method without a network, judged and timed on this machine.

`command` orders the sections, each of one file: `accuracy` (frozen test set), `timing` and `processes` (run time, in
processes of their own), `macs` and `peak` (how near the machine's limit), `against` (a peer's network), `compare` (an
earlier bench). `record` is what is kept, `tables` and `plot` what is shown.
"""
