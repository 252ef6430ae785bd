"""Images to a radiance field, and back to images."""
