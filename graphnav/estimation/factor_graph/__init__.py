"""GTSAM: elimination of the batch problem, iSAM2's tree, and export of problems as its graphs. Nothing else imports it.

The rows come from `graphnav.estimation.solvers`, which knows nothing of this package.
"""
