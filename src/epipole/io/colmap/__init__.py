"""COLMAP models and databases."""
