"""Draw the images of these pages: `python docs/make_pictures.py`. Everything in them comes from the package."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.config import FeatureConfig
from epipole.disparity_search.search import match_stereo
from epipole.features import detect_features, match_descriptors
from epipole.geometry import Rigid3, Rotation3, epipolar_lines
from epipole.image import color_map
from epipole.mapping import bundle_problem_of
from epipole.optim import adjust_bundle, bundle_covariance, with_fixed_gauge
from epipole.pipelines.stereo.config import StereoConfig
from epipole.robust import (
    RansacConfig,
    estimate_absolute_pose,
    estimate_fundamental_matrix,
    estimate_homography,
    estimate_relative_pose,
    triangulate_points,
)
from epipole.synthetic import courtyard, courtyard_views, render
from epipole.synthetic.problems import absolute_pose_problem, bundle_problem
from epipole.synthetic.stereo_rooms import stereo_room

IMAGES = Path(__file__).with_name("pictures")
CAMERA = Camera(CameraModel.PINHOLE, 720, 480, np.array([620.0, 620.0, 359.5, 239.5]))
INK, GRID, BLUE, RED = (60, 60, 60), (225, 225, 225), (180, 110, 40), (50, 60, 200)


def two_pictures() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Two views of the courtyard and the pixels of their SIFT matches."""
    views = courtyard_views(24)
    images = [render(courtyard(), CAMERA, views[k]).rgb[:, :, ::-1].copy() for k in (10, 12)]
    features = [detect_features(cv2.cvtColor(i, cv2.COLOR_BGR2GRAY), FeatureConfig()) for i in images]
    matches = match_descriptors(features[0].descriptors, features[1].descriptors)
    pixels = [f.pixels[matches[:, side]].astype(float) for side, f in enumerate(features)]
    return images[0], images[1], pixels[0], pixels[1]


def save(name: str, image: np.ndarray, suffix: str = "png") -> None:
    """Under docs/pictures."""
    IMAGES.mkdir(exist_ok=True)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 85] if suffix == "jpg" else []
    cv2.imwrite(str(IMAGES / f"{name}.{suffix}"), image, quality)


def homography() -> None:
    """Image 1 carried onto image 2 by a plane of the scene: the plane is sharp, all else is double."""
    one, two, x1, x2 = two_pictures()
    found = estimate_homography(x1, x2)
    moved = cv2.warpPerspective(one, found.model, (two.shape[1], two.shape[0]))
    blend = np.where(moved.any(axis=2, keepdims=True), 0.5 * moved + 0.5 * two, two).astype(np.uint8)
    for p, good in zip(x2, found.inlier_mask):
        cv2.circle(blend, tuple(np.rint(p).astype(int)), 3, (80, 220, 80) if good else RED, 1, cv2.LINE_AA)
    save("homography", blend, "jpg")


def fundamental() -> None:
    """Points of image 1 and the lines of image 2 on which their partners lie."""
    one, two, x1, x2 = two_pictures()
    found = estimate_fundamental_matrix(x1, x2, RansacConfig(max_error_px=1.5))
    chosen = np.flatnonzero(found.inlier_mask)[:: max(1, found.num_inliers // 14)]
    colors = cv2.applyColorMap(np.linspace(0, 255, len(chosen)).astype(np.uint8), cv2.COLORMAP_TURBO).reshape(
        -1, 3
    )
    width = two.shape[1]
    for k, line, color in zip(chosen, epipolar_lines(found.model, x1[chosen]), colors.tolist()):
        ends = [(x, round(-(line[2] + line[0] * x) / line[1])) for x in (0, width)]
        cv2.line(two, *ends, color, 1, cv2.LINE_AA)
        for image, p in ((one, x1[k]), (two, x2[k])):
            cv2.circle(image, tuple(np.rint(p).astype(int)), 5, color, 2, cv2.LINE_AA)
    save("fundamental", np.hstack([one, two]), "jpg")


def curve(
    name: str,
    x: np.ndarray,
    series: list[tuple[str, np.ndarray, tuple[int, int, int]]],
    labels: tuple[str, str],
) -> None:
    """A plot with logarithmic axes."""
    width, height, left, right, top, bottom = 720, 420, 80, 24, 36, 64
    image = np.full((height, width, 3), 255, np.uint8)
    values = np.concatenate([v for _, v, _ in series])
    low, high = np.floor(np.log10(values.min())), np.ceil(np.log10(values.max()))

    def position(a: float, b: float) -> tuple[int, int]:
        u = (np.log10(a) - np.log10(x[0])) / (np.log10(x[-1]) - np.log10(x[0]))
        v = (np.log10(b) - low) / (high - low)
        return round(left + u * (width - left - right)), round(height - bottom - v * (height - top - bottom))

    def write(text: str, at: tuple[int, int], color: tuple[int, int, int] = INK) -> None:
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, 1, cv2.LINE_AA)

    for power in np.arange(low, high + 1):
        y = position(x[0], 10.0**power)[1]
        cv2.line(image, (left, y), (width - right, y), GRID, 1)
        write(f"{10.0**power:g}", (18, y + 5))
    for value in x[:: max(1, len(x) // 6)]:
        at = position(value, 10.0**low)
        cv2.line(image, (at[0], top), at, GRID, 1)
        write(f"{value:.2g}", (at[0] - 12, at[1] + 20))
    for row, (text, v, color) in enumerate(series):
        points = np.array([position(a, b) for a, b in zip(x, v)])
        cv2.polylines(image, [points], False, color, 2, cv2.LINE_AA)
        for p in points:
            cv2.circle(image, tuple(p), 3, color, -1, cv2.LINE_AA)
        write(text, (width - 330, top + 16 + 20 * row), color)
    write(labels[0], (left + 150, height - 18))
    write(labels[1], (left - 50, 22))
    save(name, image)


def _pair(
    points: np.ndarray, baseline: float, rng: np.random.Generator
) -> tuple[Rigid3, np.ndarray, np.ndarray]:
    motion = Rigid3(Rotation3.exp(np.array([0.0, 0.03, 0.01])).matrix, np.array([-baseline, 0.0, 0.0]))
    noise = 0.5 * rng.standard_normal((2, len(points), 2))
    return motion, CAMERA.project(points) + noise[0], CAMERA.project(motion.apply(points)) + noise[1]


def relative_pose() -> None:
    """Error of the direction against the baseline, and what the covariance says of it."""
    rng = np.random.default_rng(0)
    baselines = np.geomspace(0.02, 2.0, 9)
    errors, given = [], []
    for baseline in baselines:
        seen, said = [], []
        for _ in range(40):
            points = rng.uniform([-2, -1.3, 4], [2, 1.3, 9], (200, 3))
            motion, x1, x2 = _pair(points, baseline, rng)
            found = estimate_relative_pose(x1, x2, CAMERA, CAMERA, RansacConfig(max_error_px=2))
            cosine = np.clip(found.model.translation @ motion.translation / baseline, -1, 1)
            seen.append(np.degrees(np.arccos(cosine)))
            said.append(np.degrees(np.sqrt(np.trace(found.covariance[:3, :3]) / 2)))
        errors.append(np.median(seen))
        given.append(np.median(said))
    series = [("measured, median", np.array(errors), RED), ("said by the covariance", np.array(given), BLUE)]
    curve(
        "relative_pose",
        baselines,
        series,
        ("baseline (points at depths of 4 to 9)", "error of the direction (degrees)"),
    )


def triangulation() -> None:
    """Error of depth against the angle between the rays."""
    rng = np.random.default_rng(1)
    points = rng.uniform([-1.5, -1, 5], [1.5, 1, 7], (3000, 3))
    baselines = np.geomspace(0.02, 4.0, 9)
    errors, angles = [], []
    for baseline in baselines:
        motion, x1, x2 = _pair(points, baseline, rng)
        cams = Rigid3(np.stack([np.eye(3), motion.rotation]), np.stack([np.zeros(3), motion.translation]))
        found = triangulate_points(cams, CAMERA, np.stack([x1, x2]))
        errors.append(np.nanmedian(np.abs(found.points_in_world[:, 2] / points[:, 2] - 1.0)) * 100)
        angles.append(np.degrees(np.median(found.angles_rad)))
    curve(
        "triangulation",
        np.array(angles),
        [("half a pixel of noise, median", np.array(errors), RED)],
        ("angle between the rays (degrees)", "error of depth (%)"),
    )


def absolute_pose() -> None:
    """Error of a pose against the number of points, half of them wrong."""
    counts = np.array([12, 25, 50, 100, 200, 400, 800, 1600])
    errors, given = [], []
    for count in counts:
        seen, said = [], []
        for seed in range(40):
            p = absolute_pose_problem(int(count), 0.5, 1.0, seed)
            config = RansacConfig(max_error_px=4, min_inliers=4, min_inlier_ratio=0.2)
            found = estimate_absolute_pose(p.points_in_world, p.pixels, p.camera, config)
            rotation = Rotation3(found.model.rotation) @ Rotation3(p.cam_from_world.rotation).inverse()
            seen.append(np.degrees(float(rotation.angle_rad())))
            said.append(np.degrees(np.sqrt(np.trace(found.covariance[3:, 3:]))))
        errors.append(np.median(seen))
        given.append(np.median(said))
    series = [("measured, median", np.array(errors), RED), ("said by the covariance", np.array(given), BLUE)]
    curve("absolute_pose", counts, series, ("points, half of them wrong", "error of rotation (degrees)"))


def bundle_adjustment() -> None:
    """A ring of cameras from above: the start, the adjusted places, and their ellipses, forty times enlarged."""
    problem = bundle_problem(24, 500, 4, 0.7)
    bundle = with_fixed_gauge(bundle_problem_of(problem.start))
    result = adjust_bundle(bundle)
    covariance = bundle_covariance(bundle, result)
    positions, enlarged = result.rig_from_world, 40.0
    # d centre = -R^T d translation
    rotated = np.swapaxes(positions.rotation, 1, 2)
    spread = rotated @ covariance.rig_from_world[:, :3, :3] @ positions.rotation
    image = np.full((560, 720, 3), 255, np.uint8)

    def pixel(at: np.ndarray) -> tuple[int, int]:
        return round(360 + 55 * at[0]), round(285 - 55 * at[1])

    for point in result.points_in_world:
        cv2.circle(image, pixel(point), 1, (150, 150, 150), -1, cv2.LINE_AA)
    starts, centers = bundle.rig_from_world.centers(), positions.centers()
    for f in range(len(centers)):
        cv2.circle(image, pixel(starts[f]), 4, (170, 170, 170), 1, cv2.LINE_AA)
        values, axes = np.linalg.eigh(spread[f][:2, :2])
        lengths = tuple(np.rint(55 * enlarged * np.sqrt(np.maximum(values, 0.0))).astype(int).tolist())
        angle = -np.degrees(np.arctan2(axes[1, 0], axes[0, 0]))
        cv2.ellipse(image, pixel(centers[f]), lengths, angle, 0, 360, RED, 1, cv2.LINE_AA)
        cv2.circle(image, pixel(centers[f]), 3, BLUE, -1, cv2.LINE_AA)
    for row, (text, color) in enumerate(
        (
            ("start", (150, 150, 150)),
            ("adjusted", BLUE),
            ("one standard deviation, 40 x, from the camera that is held", RED),
        )
    ):
        cv2.putText(image, text, (14, 22 + 20 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, 1, cv2.LINE_AA)
    save("bundle_adjustment", image)


def bundle_growth() -> None:
    """Seconds and memory of ever larger cities, as `python -m benchmarks.growth` left them."""
    cities = json.loads((IMAGES.parents[1] / "benchmarks/results/growth.json").read_text())["cities"]
    millions, seconds, memory = (
        np.array([city[key] for city in cities]) * factor
        for key, factor in (("observations", 1e-6), ("seconds", 1.0), ("peak_gb", 1.0))
    )
    series = [("seconds to convergence", seconds, RED), ("peak memory (GB)", memory, BLUE)]
    curve("bundle_growth", millions, series, ("million observations", "seconds, GB"))


def stereo() -> None:
    """A rendered pair: the left image, its disparities, their standard deviations, and the errors in units of them."""
    pair = stereo_room(2, (480, 360))
    limit = int(np.nanmax(pair.disparity_px)) + 8
    found = match_stereo(pair.left, pair.right, StereoConfig(max_disparity_px=limit))
    error = np.abs(found.disparity_px - pair.disparity_px) / found.sigma_px
    panels = [
        np.repeat(pair.left[..., None], 3, axis=2),
        *(color_map(values) for values in (found.disparity_px, found.sigma_px, np.minimum(error, 3.0))),
    ]
    rows = [np.hstack(panels[:2]), np.hstack(panels[2:])]
    cv2.imwrite(str(IMAGES / "stereo.jpg"), np.vstack(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


def stereo_range() -> None:
    """Error of depth against range, as `python -m benchmarks.stereo_depth` left it."""
    streets = json.loads((IMAGES.parents[1] / "benchmarks/results/stereo_depth.json").read_text())["streets"]
    middles = np.array([np.sqrt(np.prod([float(w) for w in name.split()[:3:2]])) for name in streets])
    measured, predicted = (
        np.array([row[key] for row in streets.values()]) for key in ("measured m", "predicted m")
    )
    series = [("measured, 68 % are smaller", measured, BLUE), ("Z^2 / (f B) sigma_d", predicted, RED)]
    curve("stereo_range", middles, series, ("depth, m", "error of depth, m"))


def conventions() -> None:
    """The camera's axes, a corner of the pixel grid in both ways of counting, and the names of motions."""
    parts: list[str] = []

    def line(a: tuple[float, float], b: tuple[float, float], color: str = "#444", more: str = "") -> None:
        ends = f'x1="{a[0]}" y1="{a[1]}" x2="{b[0]}" y2="{b[1]}"'
        parts.append(f'<line {ends} stroke="{color}" stroke-width="1.6" {more}/>')

    def word(x: float, y: float, text: str, color: str = "#333", more: str = "") -> None:
        parts.append(f'<text x="{x}" y="{y}" fill="{color}" {more}>{text}</text>')

    arrow = 'marker-end="url(#tip)"'
    red, green, blue = "#b3261e", "#2e7d32", "#1f5fa8"
    # the camera: its centre, an image in front of it, and its axes
    eye, corners = (70, 200), [(140, 64), (300, 64), (300, 170), (140, 170)]
    for corner in corners:
        line(eye, corner, "#aaa")
    points = " ".join(f"{x},{y}" for x, y in corners)
    parts.append(f'<polygon points="{points}" fill="#eef2f7" stroke="#666"/>')
    line(eye, (340, 52), blue, arrow)
    line(eye, (140, 200), red, arrow)
    line(eye, (70, 262), green, arrow)
    word(308, 44, "z forward", blue)
    word(148, 205, "x right", red)
    word(78, 262, "y down", green)
    word(14, 204, "camera")
    word(252, 186, "picture", "#666")
    # pixels: whole numbers are centres; COLMAP counts from the corner
    left, top, side = 420, 74, 62
    for k in range(4):
        line((left, top + side * min(k, 3)), (left + 3 * side, top + side * min(k, 3)), "#999")
        line((left + side * k, top), (left + side * k, top + 3 * side), "#999")
    for column in range(3):
        for row in range(3):
            x, y = left + side * (column + 0.5), top + side * (row + 0.5)
            parts.append(f'<circle cx="{x}" cy="{y}" r="3" fill="{blue}"/>')
            word(x, y + 20, f"({column}, {row})", blue, 'text-anchor="middle"')
    parts.append(f'<circle cx="{left}" cy="{top}" r="4" fill="{red}"/>')
    word(left - 34, top - 28, "the corner: (-0.5, -0.5) in epipole and OpenCV,", red)
    word(left - 34, top - 11, "(0, 0) in COLMAP's files", red)
    word(
        left - 34,
        top + 3 * side + 22,
        "the first pixel's centre: (0, 0) here, (0.5, 0.5) in COLMAP's files",
        blue,
    )
    # motions: names that cancel
    word(60, 306, "points_in_cam = cam_from_world.apply(points_in_world)", more='class="code"')
    word(60, 328, "cam2_from_world = cam2_from_cam1 @ cam1_from_world", more='class="code"')
    style = "text { font: 13px sans-serif } .code { font: 14px monospace }"
    tip = '<marker id="tip" markerWidth="8" markerHeight="8" refX="6" refY="3" orient="auto"><path d="M0,0 L6,3 L0,6 z" fill="#444"/></marker>'
    body = "\n".join(parts)
    title = "<title>The camera's axes, pixel centres and corners, and names of motions</title>"
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 790 345">{title}<style>{style}</style><defs>{tip}</defs>'
    svg += f'<rect width="790" height="345" fill="white"/>\n{body}\n</svg>\n'
    (IMAGES / "conventions.svg").write_text(svg, encoding="utf-8")


if __name__ == "__main__":
    for render in (
        *(conventions, homography, fundamental, relative_pose, triangulation, absolute_pose),
        *(bundle_adjustment, bundle_growth, stereo, stereo_range),
    ):
        render()
