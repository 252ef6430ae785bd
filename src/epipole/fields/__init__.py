"""Radiance fields: scene representations that are optimized on images and rendered from any viewpoint."""
