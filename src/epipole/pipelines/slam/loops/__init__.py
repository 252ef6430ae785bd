"""Recognizing revisited parts of a map, and correcting the drift."""
