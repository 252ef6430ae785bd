"""Pictures to a radiance field, and back to pictures."""
