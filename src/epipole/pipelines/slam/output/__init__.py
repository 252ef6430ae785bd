"""What a run writes: results, checks, pages, and the files that a stopped run is continued from."""
