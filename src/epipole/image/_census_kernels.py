"""The census transform: a comparison of each pixel with its neighbors."""

import numpy as np

from epipole._jit import kernel


@kernel
def _mark_darker(others, centers, bit, bits):
    """Set a bit wherever the other pixel is darker."""
    for i in range(len(bits)):
        bits[i] = bits[i] | (bit if others[i] < centers[i] else np.uint8(0))


@kernel(allocates=True)
def census_rows(image, half_width, half_height, start, stop, out):
    """Rows start..stop of the census (Zabih and Woodfill 1994): a bit per other pixel of the window, set if it is darker.

    image (h, w); out (h, w, planes) bytes, eight bits each. The border is replicated. Each offset is processed along a full row,
    which vectorizes.
    """
    height, width = image.shape
    planes = out.shape[2]
    padded = np.empty(width + 2 * half_width, image.dtype)
    bits = np.empty((planes, width), np.uint8)
    for y in range(start, stop):
        bits[:] = 0
        position = 0
        for dy in range(-half_height, half_height + 1):
            row = image[min(max(y + dy, 0), height - 1)]
            padded[:half_width] = row[0]
            padded[half_width : half_width + width] = row
            padded[half_width + width :] = row[width - 1]
            for n in range(2 * half_width + 1):
                if dy == 0 and n == half_width:
                    continue
                _mark_darker(
                    padded[n : n + width], image[y], np.uint8(1 << (position & 7)), bits[position >> 3]
                )
                position += 1
        for x in range(width):
            for p in range(planes):
                out[y, x, p] = bits[p, x]
