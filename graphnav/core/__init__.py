"""Foundations of all other packages: errors, files, time, rotations, the Earth, states and trajectories."""
