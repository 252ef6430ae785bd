"""Localization of images in a finished model."""
