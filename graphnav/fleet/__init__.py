"""Many recordings with one command: each solved apart from the others, one row each, one page for all.

`graphnav.fleet.manifest` finds the drives and their settings, `graphnav.fleet.workers` shares them out to processes or
to a Dask cluster, `graphnav.fleet.drive` solves one of them, `graphnav.fleet.tables` and `graphnav.fleet.page` write
what came of it. What is written per drive is all that there is to go on from: a run that was killed goes on.
"""
