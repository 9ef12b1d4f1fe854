"""Error against run time: every model and every method without a network, evaluated and timed on this machine.

`command` orders the sections, each of one file: `accuracy` (frozen test set), `timing` and `processes` (run time, in
processes of their own), `macs` and `peak` (distance from the machine's limit), `peer_ratios` (a peer's network),
`compare` (an earlier bench). `record` holds the results, `report` and `plot` show them.
"""
