"""The report of a reconstruction."""
