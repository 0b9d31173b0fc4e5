"""From a recording to solutions: the problem, its noise model, and the solvers."""
