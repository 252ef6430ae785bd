"""Models in other formats than COLMAP's: nerfstudio, Bundler, BAL, LLFF."""
