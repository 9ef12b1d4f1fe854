"""Error against run time of every model and of methods without a network, and the cost of the whole program.

`command` orders the tables, `accuracy` has the error on the frozen test set, `timing` and `processes` the run time, in
processes of their own (`worker`); `system` measures the whole program from outside.
"""
