"""GPS positions of images: whether they belong to a model, and the similarity that maps the model onto them."""
