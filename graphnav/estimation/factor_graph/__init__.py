"""What GTSAM does: the batch problem's elimination, iSAM2's tree, and problems as its graphs. Nothing else imports it.

The rows come from `graphnav.estimation.solvers`, which knows nothing of this package.
"""
