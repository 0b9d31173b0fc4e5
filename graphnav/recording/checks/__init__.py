"""Checks of a recording before it is solved: clocks, axes, units, gaps."""
