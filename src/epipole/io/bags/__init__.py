"""ROS and MCAP recordings."""
