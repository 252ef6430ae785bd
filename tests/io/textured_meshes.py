"""A small mesh with two textures, for the tests of its file formats."""

import numpy as np

from epipole.scene import TexturedMesh

RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
UTM = np.array([500_123.4567, 5_412_345.6789, 321.1234])


def four_colors(height: int, width: int) -> np.ndarray:
    """A texture that is red at the top left, green at the top right, blue at the bottom left, white at the bottom right."""
    out = np.zeros((height, width, 3), np.uint8)
    top, left = np.arange(height)[:, None] < height // 2, np.arange(width)[None] < width // 2
    for is_there, color in (
        (top & left, RED),
        (top & ~left, GREEN),
        (~top & left, BLUE),
        (~top & ~left, WHITE),
    ):
        out[is_there] = color
    return out


def corner_mesh(origin: np.ndarray | float = 0.0) -> TexturedMesh:
    """Two perpendicular squares with a common edge; the first shows the colors of `four_colors` at its corners."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1]], np.float64)
    square = np.array([[0.125, 0.125], [0.875, 0.125], [0.875, 0.875], [0.125, 0.875]])
    uv = np.stack([square[[0, 1, 2]], square[[0, 2, 3]], square[[0, 3, 2]], square[[0, 2, 1]]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 4, 5], [0, 5, 1]])
    textures = (four_colors(64, 96), four_colors(32, 32)[:, ::-1])
    return TexturedMesh(vertices + origin, faces, uv, np.array([0, 0, 1, 1]), textures)


def color_at(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """The color of the pixel at texture coordinates with their origin at the top left."""
    height, width = texture.shape[:2]
    return texture[int(uv[1] * height), int(uv[0] * width)].astype(int)


def large_mesh(side: int) -> TexturedMesh:
    """A square grid of side x side vertices with one texture, and texture coordinates that are continuous."""
    row, column = np.divmod(np.arange(side * side), side)
    vertices = np.stack([column, row, np.sin(0.1 * column)], axis=1).astype(np.float64)
    first = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([first, first + side, first + 1], 1),
            np.stack([first + 1, first + side, first + side + 1], 1),
        ]
    )
    uv = (np.stack([column, row], axis=1) / (side - 1))[faces]
    return TexturedMesh(vertices, faces, uv, np.zeros(len(faces), np.int64), (four_colors(64, 64),))
