"""The demo: the whole way from photographs to a model, on a scene whose truth is known."""
