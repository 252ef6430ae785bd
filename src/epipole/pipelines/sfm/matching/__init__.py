"""From images to verified pairs."""
