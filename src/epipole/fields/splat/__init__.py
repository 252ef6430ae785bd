"""3D Gaussian Splatting."""
