"""The `render` job: images of a stored field, along a path or from given cameras, here or on other machines."""
