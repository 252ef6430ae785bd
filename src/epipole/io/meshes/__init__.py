"""PLY files of points and meshes."""
