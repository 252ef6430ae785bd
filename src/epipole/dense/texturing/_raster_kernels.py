"""Rasterization of triangles: which face a view sees at each pixel, and values interpolated over the faces of an atlas."""

import numpy as np

from epipole._jit import kernel


@kernel
def render_faces(pixels, depth, faces, inverse, face_of_pixel):
    """Render all faces with a depth buffer: inverse (h, w) receives 1/z, face_of_pixel (h, w) the nearest face.

    pixels (n, 2) and depth (n) of the vertices; faces with a vertex behind the camera or not finite are skipped. 1/z is linear in the image. A
    pixel belongs to a face if its center is inside.
    """
    height, width = inverse.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if not (depth[a] > 0.0 and depth[b] > 0.0 and depth[c] > 0.0):
            continue
        ax, ay, bx, by, cx, cy = (
            pixels[a, 0],
            pixels[a, 1],
            pixels[b, 0],
            pixels[b, 1],
            pixels[c, 0],
            pixels[c, 1],
        )
        low_x, high_x = min(ax, bx, cx), max(ax, bx, cx)
        low_y, high_y = min(ay, by, cy), max(ay, by, cy)
        if not (high_x >= 0.0 and high_y >= 0.0 and low_x <= width - 1.0 and low_y <= height - 1.0):
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        qa, qb, qc = 1.0 / depth[a], 1.0 / depth[b], 1.0 / depth[c]
        for y in range(int(max(np.ceil(low_y), 0.0)), int(min(np.floor(high_y), height - 1.0)) + 1):
            for x in range(int(max(np.ceil(low_x), 0.0)), int(min(np.floor(high_x), width - 1.0)) + 1):
                wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                wc = 1.0 - wa - wb
                if wa < 0.0 or wb < 0.0 or wc < 0.0:
                    continue
                q = wa * qa + wb * qb + wc * qc
                if q > inverse[y, x]:
                    inverse[y, x], face_of_pixel[y, x] = q, f


@kernel
def paint_values(corners, values, out, painted):
    """Interpolate values (m, 3, 3) of the corners of triangles, at pixels (m, 3, 2), into out (h, w, 3); painted (h, w) becomes one.

    A triangle is painted up to half a pixel beyond its edges, so that no pixel between two is left out.
    """
    height, width = painted.shape
    for f in range(len(corners)):
        ax, ay = corners[f, 0, 0], corners[f, 0, 1]
        bx, by = corners[f, 1, 0], corners[f, 1, 1]
        cx, cy = corners[f, 2, 0], corners[f, 2, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        low_x, high_x = int(np.floor(min(ax, bx, cx))), int(np.ceil(max(ax, bx, cx)))
        low_y, high_y = int(np.floor(min(ay, by, cy))), int(np.ceil(max(ay, by, cy)))
        for y in range(max(low_y, 0), min(high_y, height - 1) + 1):
            for x in range(max(low_x, 0), min(high_x, width - 1) + 1):
                wa = wb = wc = 1.0 / 3.0
                if abs(area) > 1e-12:
                    wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                    wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                    wc = 1.0 - wa - wb
                    inside = wa >= 0.0 and wb >= 0.0 and wc >= 0.0
                    if not inside and painted[y, x] != 0:
                        continue
                    wa, wb, wc = min(max(wa, 0.0), 1.0), min(max(wb, 0.0), 1.0), min(max(wc, 0.0), 1.0)
                    total = wa + wb + wc
                    wa, wb, wc = wa / total, wb / total, wc / total
                    px, py = wa * ax + wb * bx + wc * cx, wa * ay + wb * by + wc * cy
                    if not inside and (px - x) ** 2 + (py - y) ** 2 > 1.0:
                        continue
                for k in range(3):
                    out[y, x, k] = wa * values[f, 0, k] + wb * values[f, 1, k] + wc * values[f, 2, k]
                painted[y, x] = 1
