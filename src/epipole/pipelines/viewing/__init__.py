"""Viewing the content of any result folder or file in the browser."""
