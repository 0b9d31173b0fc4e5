"""Evaluation of solutions against a truth, and against other programs."""
