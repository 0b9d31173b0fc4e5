"""Solutions against a truth, and against other programs."""
