"""Raw IMU samples, preintegrated intervals between keyframes, and IMU factors."""
