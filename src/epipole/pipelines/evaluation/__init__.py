"""Evaluation of results against ground truth."""
