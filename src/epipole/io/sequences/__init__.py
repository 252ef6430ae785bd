"""Image sequences with times, depth and IMU measurements."""
