"""Where frames and cameras come from."""
