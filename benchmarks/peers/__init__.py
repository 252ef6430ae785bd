"""The compared programs, one class each; each runs in its own process."""
