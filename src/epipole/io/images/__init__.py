"""Images, depth images and videos, and what their headers say."""
