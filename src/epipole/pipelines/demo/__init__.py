"""The demo: reconstruction of rendered photographs with known ground truth."""
