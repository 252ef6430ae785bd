"""Dense geometry of many views."""
