"""Files of surveys: control points and coordinate systems."""
