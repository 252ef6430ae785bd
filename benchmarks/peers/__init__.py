"""The programs compared, one class each, each run in a process of its own."""
