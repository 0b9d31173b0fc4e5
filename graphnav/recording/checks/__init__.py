"""What a recording shows of itself before anything is solved: clocks, axes, units, gaps."""
