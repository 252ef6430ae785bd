"""A mesh's PLY file, read by the book."""

import numpy as np


def mesh_in(path):
    """Vertices, triangles and colors."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    counts = [
        int(line.split()[-1]) for line in head.decode("ascii").splitlines() if line.startswith("element")
    ]
    corners = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3)], counts[0])
    faces = np.frombuffer(body, [("count", "u1"), ("vertices", "<i4", 3)], counts[1], corners.nbytes)
    assert (faces["count"] == 3).all() and corners.nbytes + faces.nbytes == len(body)
    return corners["xyz"], faces["vertices"], corners["rgb"]
