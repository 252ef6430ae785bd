"""The map: keyframes and points, and how they are extended, optimized and culled."""
