"""Many recordings with one command: each solved independently, one row each, one page for all.

`graphnav.app.fleet.manifest` finds the drives and their settings, `graphnav.app.fleet.workers` distributes them to
processes or to a Dask cluster, `graphnav.app.fleet.drive` solves one of them, `graphnav.app.fleet.tables` and
`graphnav.app.fleet.page` write the results. All state is in the files of each drive: a run that was killed can be
continued.
"""
