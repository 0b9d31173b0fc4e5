"""From raw IMU samples to the intervals between keyframes."""
