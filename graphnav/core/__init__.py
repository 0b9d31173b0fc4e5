"""What every other room stands on: errors, files, time, rotations, the Earth, states and trajectories."""
