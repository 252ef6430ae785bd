"""Dense disparity search: matching costs, semi-global paths and blocks, and how sure each disparity is."""
