"""Generate the figures of the documentation from rendered data: `python docs/make_pictures.py`."""

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


def matched_images() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Two images of the courtyard (BGR), and the pixels of their SIFT matches."""
    views = courtyard_views(24)
    images = [render(courtyard(), CAMERA, views[k]).rgb[:, :, ::-1].copy() for k in (10, 12)]
    features = [detect_features(cv2.cvtColor(i, cv2.COLOR_BGR2GRAY), FeatureConfig()) for i in images]
    matches = match_descriptors(features[0].descriptors, features[1].descriptors)
    pixels = [f.pixels[matches[:, side]].astype(float) for side, f in enumerate(features)]
    return images[0], images[1], pixels[0], pixels[1]


def save(name: str, image: np.ndarray, suffix: str = "png") -> None:
    """Write a figure to docs/pictures."""
    IMAGES.mkdir(exist_ok=True)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 85] if suffix == "jpg" else []
    cv2.imwrite(str(IMAGES / f"{name}.{suffix}"), image, quality)


def homography() -> None:
    """Image 1 warped onto image 2 by the homography of a plane: the plane is sharp, the rest is doubled."""
    one, two, x1, x2 = matched_images()
    found = estimate_homography(x1, x2)
    warped = cv2.warpPerspective(one, found.model, (two.shape[1], two.shape[0]))
    blend = np.where(warped.any(axis=2, keepdims=True), 0.5 * warped + 0.5 * two, two).astype(np.uint8)
    for p, is_inlier in zip(x2, found.inlier_mask):
        cv2.circle(
            blend, tuple(np.rint(p).astype(int)), 3, (80, 220, 80) if is_inlier else RED, 1, cv2.LINE_AA
        )
    save("homography", blend, "jpg")


def fundamental() -> None:
    """Points of image 1 and their epipolar lines in image 2."""
    one, two, x1, x2 = matched_images()
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
    """Plot series on logarithmic axes; infinite values are omitted."""
    width, height, left, right, top, bottom = 720, 420, 80, 24, 36, 64
    image = np.full((height, width, 3), 255, np.uint8)
    values = np.concatenate([v[np.isfinite(v)] for _, v, _ in series])
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
        write(f"{value:.2g}" if value < 100 else f"{value:.0f}", (at[0] - 12, at[1] + 20))
    for row, (text, v, color) in enumerate(series):
        points = np.array([position(a, b) for a, b in zip(x, v) if np.isfinite(b)])
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
    """Relative pose and the noisy pixels of the points in two cameras."""
    motion = Rigid3(Rotation3.exp(np.array([0.0, 0.03, 0.01])).matrix, np.array([-baseline, 0.0, 0.0]))
    noise = 0.5 * rng.standard_normal((2, len(points), 2))
    return motion, CAMERA.project(points) + noise[0], CAMERA.project(motion.apply(points)) + noise[1]


def relative_pose() -> None:
    """Error and standard deviation of the translation direction against the baseline."""
    rng = np.random.default_rng(0)
    baselines = np.geomspace(0.02, 2.0, 9)
    errors_deg, sigmas_deg = [], []
    for baseline in baselines:
        run_errors, run_sigmas = [], []
        for _ in range(40):
            points = rng.uniform([-2, -1.3, 4], [2, 1.3, 9], (200, 3))
            motion, x1, x2 = _pair(points, baseline, rng)
            found = estimate_relative_pose(x1, x2, CAMERA, CAMERA, RansacConfig(max_error_px=2))
            cosine = np.clip(found.model.translation @ motion.translation / baseline, -1, 1)
            run_errors.append(np.degrees(np.arccos(cosine)))
            run_sigmas.append(np.degrees(np.sqrt(np.trace(found.covariance[:3, :3]) / 2)))
        errors_deg.append(np.median(run_errors))
        sigmas_deg.append(np.median(run_sigmas))
    series = [
        ("median error", np.array(errors_deg), RED),
        ("standard deviation, median (first: infinite)", np.array(sigmas_deg), BLUE),
    ]
    curve(
        "relative_pose",
        baselines,
        series,
        ("baseline (points at depths of 4 to 9)", "direction error (degrees)"),
    )


def triangulation() -> None:
    """Depth error against the angle between the rays."""
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
        [("median error, 0.5 px of noise", np.array(errors), RED)],
        ("angle between the rays (degrees)", "depth error (%)"),
    )


def absolute_pose() -> None:
    """Rotation error of an absolute pose against the number of points, half of them outliers."""
    counts = np.array([12, 25, 50, 100, 200, 400, 800, 1600])
    errors_deg, sigmas_deg = [], []
    for count in counts:
        run_errors, run_sigmas = [], []
        for seed in range(40):
            p = absolute_pose_problem(int(count), 0.5, 1.0, seed)
            config = RansacConfig(max_error_px=4, min_inliers=4, min_inlier_ratio=0.2)
            found = estimate_absolute_pose(p.points_in_world, p.pixels, p.camera, config)
            rotation = Rotation3(found.model.rotation) @ Rotation3(p.cam_from_world.rotation).inverse()
            run_errors.append(np.degrees(float(rotation.angle_rad())))
            run_sigmas.append(np.degrees(np.sqrt(np.trace(found.covariance[3:, 3:]))))
        errors_deg.append(np.median(run_errors))
        sigmas_deg.append(np.median(run_sigmas))
    series = [
        ("median error", np.array(errors_deg), RED),
        ("standard deviation, median", np.array(sigmas_deg), BLUE),
    ]
    curve("absolute_pose", counts, series, ("points, half of them outliers", "rotation error (degrees)"))


def bundle_adjustment() -> None:
    """A ring of cameras from above: initial and optimized positions, with error ellipses magnified 40 times."""
    problem = bundle_problem(24, 500, 4, 0.7)
    bundle = with_fixed_gauge(bundle_problem_of(problem.start))
    result = adjust_bundle(bundle)
    covariance = bundle_covariance(bundle, result)
    poses, magnification = result.rig_from_world, 40.0
    # First order: d center = -R^T d translation.
    world_from_rig = np.swapaxes(poses.rotation, 1, 2)
    spread = world_from_rig @ covariance.rig_from_world[:, :3, :3] @ poses.rotation
    image = np.full((560, 720, 3), 255, np.uint8)

    def pixel(at: np.ndarray) -> tuple[int, int]:
        return round(360 + 55 * at[0]), round(285 - 55 * at[1])

    for point in result.points_in_world:
        cv2.circle(image, pixel(point), 1, (150, 150, 150), -1, cv2.LINE_AA)
    starts, centers = bundle.rig_from_world.centers(), poses.centers()
    for f in range(len(centers)):
        cv2.circle(image, pixel(starts[f]), 4, (170, 170, 170), 1, cv2.LINE_AA)
        values, axes = np.linalg.eigh(spread[f][:2, :2])
        lengths = tuple(np.rint(55 * magnification * np.sqrt(np.maximum(values, 0.0))).astype(int).tolist())
        angle = -np.degrees(np.arctan2(axes[1, 0], axes[0, 0]))
        cv2.ellipse(image, pixel(centers[f]), lengths, angle, 0, 360, RED, 1, cv2.LINE_AA)
        cv2.circle(image, pixel(centers[f]), 3, BLUE, -1, cv2.LINE_AA)
    for row, (text, color) in enumerate(
        (
            ("initial position", (150, 150, 150)),
            ("optimized position", BLUE),
            ("one standard deviation, magnified 40 times; one camera is fixed", RED),
        )
    ):
        cv2.putText(image, text, (14, 22 + 20 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, 1, cv2.LINE_AA)
    save("bundle_adjustment", image)


def bundle_growth() -> None:
    """Time and memory against the size of the problem, from the results of `python -m benchmarks.growth`."""
    cities = json.loads((IMAGES.parents[1] / "benchmarks/results/growth.json").read_text())["cities"]
    millions, seconds, memory = (
        np.array([city[key] for city in cities]) * factor
        for key, factor in (("observations", 1e-6), ("seconds", 1.0), ("peak_gb", 1.0))
    )
    series = [("seconds to convergence", seconds, RED), ("peak memory (GB)", memory, BLUE)]
    curve("bundle_growth", millions, series, ("million observations", "seconds, GB"))


def mapping_growth() -> None:
    """Time and memory of mapping against its size, from the results of `python -m benchmarks.mapping_growth`."""
    drives = json.loads((IMAGES.parents[1] / "benchmarks/results/mapping_growth.json").read_text())["drives"]
    millions, seconds, memory = (
        np.array([drive[key] for drive in drives]) * factor
        for key, factor in (("observations", 1e-6), ("seconds", 1.0), ("peak_gb", 1.0))
    )
    series = [("seconds of mapping", seconds, RED), ("peak memory (GB)", memory, BLUE)]
    curve("mapping_growth", millions, series, ("million observations", "seconds, GB"))


def stereo() -> None:
    """A rendered pair: left image, disparity, standard deviation, and error in standard deviations."""
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
    """Depth error against depth, from the results of `python -m benchmarks.stereo_depth`."""
    streets = json.loads((IMAGES.parents[1] / "benchmarks/results/stereo_depth.json").read_text())["streets"]
    middles = np.array([np.sqrt(np.prod([float(w) for w in name.split()[:3:2]])) for name in streets])
    measured, predicted = (
        np.array([row[key] for row in streets.values()]) for key in ("measured m", "predicted m")
    )
    series = [("measured, 68th percentile", measured, BLUE), ("Z^2 / (f B) sigma_d", predicted, RED)]
    curve("stereo_range", middles, series, ("depth (m)", "depth error (m)"))


def conventions() -> None:
    """Camera axes, pixel coordinates in epipole and COLMAP, and names of motions."""
    parts: list[str] = []

    def line(
        a: tuple[float, float], b: tuple[float, float], color: str = "#444", attributes: str = ""
    ) -> None:
        ends = f'x1="{a[0]}" y1="{a[1]}" x2="{b[0]}" y2="{b[1]}"'
        parts.append(f'<line {ends} stroke="{color}" stroke-width="1.6" {attributes}/>')

    def label(x: float, y: float, text: str, color: str = "#333", attributes: str = "") -> None:
        parts.append(f'<text x="{x}" y="{y}" fill="{color}" {attributes}>{text}</text>')

    arrow = 'marker-end="url(#tip)"'
    red, green, blue = "#b3261e", "#2e7d32", "#1f5fa8"
    # The camera center, the image plane and the axes.
    center, corners = (70, 200), [(140, 64), (300, 64), (300, 170), (140, 170)]
    for corner in corners:
        line(center, corner, "#aaa")
    points = " ".join(f"{x},{y}" for x, y in corners)
    parts.append(f'<polygon points="{points}" fill="#eef2f7" stroke="#666"/>')
    line(center, (340, 52), blue, arrow)
    line(center, (140, 200), red, arrow)
    line(center, (70, 262), green, arrow)
    label(308, 44, "z forward", blue)
    label(148, 205, "x right", red)
    label(78, 262, "y down", green)
    label(14, 204, "camera")
    label(252, 186, "image", "#666")
    # Pixel centers have integer coordinates here; COLMAP puts the origin at the corner.
    left, top, side = 420, 74, 62
    for k in range(4):
        line((left, top + side * min(k, 3)), (left + 3 * side, top + side * min(k, 3)), "#999")
        line((left + side * k, top), (left + side * k, top + 3 * side), "#999")
    for column in range(3):
        for row in range(3):
            x, y = left + side * (column + 0.5), top + side * (row + 0.5)
            parts.append(f'<circle cx="{x}" cy="{y}" r="3" fill="{blue}"/>')
            label(x, y + 20, f"({column}, {row})", blue, 'text-anchor="middle"')
    parts.append(f'<circle cx="{left}" cy="{top}" r="4" fill="{red}"/>')
    label(left - 34, top - 28, "image corner: (-0.5, -0.5) in epipole and OpenCV,", red)
    label(left - 34, top - 11, "(0, 0) in COLMAP files", red)
    label(
        left - 34,
        top + 3 * side + 22,
        "center of the first pixel: (0, 0) here, (0.5, 0.5) in COLMAP files",
        blue,
    )
    # Adjacent names of motions cancel.
    label(60, 306, "points_in_cam = cam_from_world.apply(points_in_world)", attributes='class="code"')
    label(60, 328, "cam2_from_world = cam2_from_cam1 @ cam1_from_world", attributes='class="code"')
    style = "text { font: 13px sans-serif } .code { font: 14px monospace }"
    tip = '<marker id="tip" markerWidth="8" markerHeight="8" refX="6" refY="3" orient="auto"><path d="M0,0 L6,3 L0,6 z" fill="#444"/></marker>'
    body = "\n".join(parts)
    title = "<title>Camera axes, pixel coordinates and names of motions</title>"
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 790 345">{title}<style>{style}</style><defs>{tip}</defs>'
    svg += f'<rect width="790" height="345" fill="white"/>\n{body}\n</svg>\n'
    (IMAGES / "conventions.svg").write_text(svg, encoding="utf-8")


if __name__ == "__main__":
    for make_figure in (
        *(conventions, homography, fundamental, relative_pose, triangulation, absolute_pose),
        *(bundle_adjustment, bundle_growth, mapping_growth, stereo, stereo_range),
    ):
        make_figure()
