"""Reading and writing of images, depth images and videos, and their headers."""
