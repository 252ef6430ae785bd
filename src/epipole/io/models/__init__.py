"""Models other than COLMAP's: nerfstudio, Bundler, BAL, LLFF."""
