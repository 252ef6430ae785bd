"""Output of a SLAM run: results, checks, report, and checkpoints for resuming."""
