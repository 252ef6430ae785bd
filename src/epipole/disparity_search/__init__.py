"""Dense disparity search: matching costs, semi-global and block matching, and uncertainty of disparities."""
