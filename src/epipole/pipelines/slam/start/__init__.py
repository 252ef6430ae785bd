"""How the map of one camera is initialized."""
