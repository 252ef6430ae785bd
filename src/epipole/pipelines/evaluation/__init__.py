"""Evaluation: results against a known truth."""
