"""Train radiance fields on images, render them and extract meshes."""
