"""Many recordings with one command: each solved apart from the others, one row each, one page for all.

`graphnav.app.fleet.manifest` finds the drives and their settings, `graphnav.app.fleet.workers` shares them out to
processes or to a Dask cluster, `graphnav.app.fleet.drive` solves one of them, `graphnav.app.fleet.tables` and
`graphnav.app.fleet.page` write what came of it. What is written per drive is all that there is to go on from: a run
that was killed goes on.
"""
