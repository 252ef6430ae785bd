"""The census transform: what is darker than the pixel in the middle."""

from epipole._jit import kernel


@kernel
def census_rows(image, half_width, half_height, start, stop, out):
    """Rows start..stop of the census (Zabih and Woodfill 1994): a bit for each other pixel of the window, set where darker.

    image (h, w); out (h, w, planes) bytes, eight bits each. Beyond the border the nearest pixel counts.
    """
    height, width = image.shape
    for y in range(start, stop):
        for x in range(width):
            center = image[y, x]
            place, bits, plane = 0, 0, 0
            for dy in range(-half_height, half_height + 1):
                row = min(max(y + dy, 0), height - 1)
                for dx in range(-half_width, half_width + 1):
                    if dy == 0 and dx == 0:
                        continue
                    if image[row, min(max(x + dx, 0), width - 1)] < center:
                        bits |= 1 << place
                    place += 1
                    if place == 8:
                        out[y, x, plane] = bits
                        place, bits, plane = 0, 0, plane + 1
            if place > 0:
                out[y, x, plane] = bits
