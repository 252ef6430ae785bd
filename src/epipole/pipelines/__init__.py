"""Whole jobs, one folder each: options, method, files, page, viewer scene and command."""
