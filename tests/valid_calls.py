"""One valid call of every public function and class of the rooms that calculate: what wrong calls are made from."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np

import valid_fields
import valid_files
import valid_jobs
from epipole import (
    cameras,
    features,
    fields,
    geometry,
    image,
    inertial,
    io,
    mapping,
    metrics,
    optim,
    robust,
    scale,
    scene,
    solvers,
    synthetic,
)
from epipole.cameras import Camera, CameraModel, image_fit
from epipole.cameras.visibility import project_visible
from epipole.config import AnchorOptions, FeatureConfig, MatchConfig, RansacConfig
from epipole.disparity_search import coarse_to_fine, config, rectification, search, uncertainty
from epipole.geometry import Rigid2, Rigid3, Rotation3, Similarity3, tangents
from epipole.geometry.homogeneous import normalize_lines
from epipole.io import g2o
from epipole.mapping.adjustment import expected_params, free_params_of
from epipole.mapping.focal_accuracy import focal_accuracies
from epipole.optim import BundleConfig, BundlePriors, Loss, PoseGraph, PoseGraphConfig
from epipole.optim.block_cholesky import BlockPattern, plan_cholesky
from epipole.pipelines.sfm.config import MapperConfig
from epipole.robust import PairMatches
from epipole.solvers.two_view import hartley_normalization
from epipole.synthetic import look_alike, problems, rides, stereo_rooms
from epipole.synthetic.inertial import inertial_path
from epipole.synthetic.ride import Shutter

ROOMS = (
    cameras,
    geometry,
    image,
    inertial,
    solvers,
    optim,
    features,
    robust,
    scale,
    scene,
    metrics,
    synthetic,
    mapping,
    fields,
    io,
)


@dataclass(frozen=True)
class Call:
    """A function, or a class, and arguments that it takes."""

    name: str
    function: Callable[..., Any]
    arguments: dict[str, Any]

    def __repr__(self) -> str:
        return self.name


@cache
def valid_calls() -> tuple[Call, ...]:
    """All of them; the arrays are made once and must not be written to."""
    return tuple(Call(name, function, arguments) for name, function, arguments in _all_calls())


Row = tuple[str, Callable[..., Any], dict[str, Any]]


def _all_calls() -> Iterator[Row]:
    for rows in (
        *(_geometry, _motions, _cameras, _solvers, _estimators, _triangulation, _bundles, _pose_graphs),
        *(_features, _images, _columns, _mapping, _inertial, _disparities, _synthetic, _metrics, _options),
        *(valid_fields.calls, valid_files.calls, valid_jobs.calls),
    ):
        yield from rows()


def _row(function: Callable[..., Any], /, **arguments: Any) -> Row:
    return function.__qualname__, function, arguments


@cache
def _pair() -> problems.TwoViewProblem:
    return problems.two_view_problem(40, 0.2, 0.3, 1)


@cache
def _seen() -> problems.AbsolutePoseProblem:
    return problems.absolute_pose_problem(40, 0.2, 0.3, 2)


@cache
def _ring() -> problems.ReconstructionProblem:
    return problems.bundle_problem(4, 20, 3, 0.3, 3)


def _some(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


IN_FRONT = np.array([0.0, 0.0, 6.0])
LENS = Camera(CameraModel.OPENCV, 64, 48, np.array([60.0, 61.0, 31.5, 23.5, -0.05, 0.01, 1e-3, -1e-3]))
PINHOLE = Camera(CameraModel.PINHOLE, 64, 48, np.array([60.0, 60.0, 31.5, 23.5]))
QUICK = RansacConfig(max_iterations=200, min_inliers=8)
PLACES = Rigid3.exp(0.1 * _some(4, 6))
PLACE = PLACES[1]


def _geometry() -> Iterator[Row]:
    p1, p2, K = _some(12, 2), _some(12, 2, seed=1), np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    E = geometry.essential_from_cam2_from_cam1(PLACE)
    F = geometry.fundamental_from_essential(E, K, K)
    rays = _some(5, 3) + IN_FRONT
    yield _row(geometry.align_points, source=rays, target=rays + 1, with_scale=True)
    yield _row(
        geometry.depth_error, depth=rays, focal_px=50.0, baseline=0.1, disparity_error_px=0.5 + 0 * rays
    )
    for function, name in (
        (geometry.depth_to_disparity, "depth"),
        (geometry.disparity_to_depth, "disparity_px"),
    ):
        yield _row(function, **{name: rays}, focal_px=50.0, baseline=0.1, principal_offset_px=1.0)
    candidates = geometry.decompose_essential_matrix(E)
    yield _row(geometry.choose_by_cheirality, candidates=candidates, rays1=rays, rays2=rays)
    yield _row(geometry.decompose_essential_matrix, essential=E)
    yield _row(geometry.epipolar_lines, fundamental=F, pixels1=p1)
    yield _row(geometry.epipoles, fundamental=F)
    yield _row(geometry.essential_from_cam2_from_cam1, cam2_from_cam1=PLACE)
    yield _row(geometry.essential_from_fundamental, fundamental=F, K1=K, K2=K)
    yield _row(geometry.fundamental_from_essential, essential=E, K1=K, K2=K)
    yield _row(geometry.sampson_error, fundamental=F, pixels1=p1, pixels2=p2)
    yield _row(geometry.to_homogeneous, points=p1)
    yield _row(geometry.from_homogeneous, points=rays)
    yield _row(geometry.intersection_of, lines_a=rays, lines_b=rays + 1)
    yield _row(geometry.line_through, points_a=p1, points_b=p2)
    yield _row(geometry.point_line_distance, points=p1[:5], lines=rays)
    yield _row(normalize_lines, lines=rays)
    H = np.eye(3) + 0.01 * _some(3, 3)
    yield _row(geometry.decompose_homography, homography=H, K1=K, K2=K, pixels1=p1)
    size = (64, 48)
    yield _row(geometry.rectifying_homographies, fundamental=F, pixels1=p1, pixels2=p2, size=size)
    yield _row(geometry.skew, vectors=rays)
    yield _row(geometry.ray_angles_rad, points=rays, centers_a=rays + 1, centers_b=rays - 1)
    yield _row(geometry.triangulate_linear, cams_from_world=PLACES, rays=rays[:4])
    yield _row(geometry.triangulate_two_view, cam2_from_cam1=PLACE, rays1=rays, rays2=rays + 1)
    yield _row(geometry.PlaneMotions, cam2_from_cam1=PLACES, normals_in_cam1=_some(4, 3))
    for function in (tangents.inverse_left_jacobian, tangents.inverse_right_jacobian):
        yield _row(function, xi=0.1 * _some(3, 6))


def _motions() -> Iterator[Row]:
    points = _some(4, 3)
    flat, similar = Rigid2.exp(_some(4, 3)), Similarity3.exp(0.1 * _some(4, 7))
    rotation = Rotation3(PLACES.rotation)
    yield _row(Rotation3, matrix=rotation.matrix)
    yield _row(Rigid3, rotation=PLACES.rotation, translation=PLACES.translation)
    yield _row(Rigid2, angle_rad=_some(4), translation=_some(4, 2))
    yield _row(Similarity3, scale=np.ones(4), rotation=PLACES.rotation, translation=points)
    yield _row(Rotation3.exp, phi_rad=points)
    yield _row(Rotation3.from_quat_wxyz, quat_wxyz=_some(4, 4))
    yield _row(Rotation3.nearest, matrix=_some(4, 3, 3))
    yield _row(Rotation3.from_two_vectors, source=points[0], target=points[1])
    yield _row(Rigid3.from_matrix, matrix=PLACES.as_matrix())
    yield _row(Rigid3.from_quat_wxyz, quat_wxyz=_some(4, 4), translation=points)
    yield _row(Rigid3.exp, xi=_some(4, 6))
    yield _row(Rigid2.exp, xi=points)
    yield _row(Rigid2.from_rigid3, motion=PLACES)
    yield _row(Similarity3.exp, xi=_some(4, 7))
    yield _row(similar.move_cam_from_source, cam_from_source=PLACES)
    for motion, given in ((rotation, points), (PLACES, points), (flat, points[:, :2]), (similar, points)):
        yield _row(motion.apply, points=given)
        yield _row(motion.__matmul__, other=motion)


def _cameras() -> Iterator[Row]:
    yield _row(Camera, model=LENS.model, width=64, height=48, params=LENS.params)
    yield _row(
        Camera.from_K, K=LENS.K, size=(64, 48), distortion=np.array([-0.1, 0.0, 0.0, 0.0]), is_fisheye=False
    )
    yield _row(LENS.project, points_in_cam=_some(5, 3) + IN_FRONT)
    yield _row(LENS.project_with_jacobian, points_in_cam=_some(5, 3) + IN_FRONT)
    yield _row(LENS.unproject, pixels=_some(5, 2))
    yield _row(LENS.unproject_with_jacobian, pixels=_some(5, 2))
    yield _row(LENS.scaled_to, width=32, height=24)
    yield _row(project_visible, camera=LENS, rays_in_cam=_some(5, 3) + IN_FRONT)
    yield _row(image_fit.rotated_camera, camera=LENS, orientation=6)
    yield _row(image_fit.rotated_pixels, pixels=_some(5, 2), size=(64, 48), orientation=6)
    yield _row(image_fit.fitted_camera, camera=LENS, width=32, height=24)
    yield _row(cameras.camera_model_named, name="opencv")
    yield _row(cameras.as_camera_model, given="OPENCV")
    yield _row(CameraModel.OPENCV.initial_params, focal_px=50.0, width=64, height=48)


def _solvers() -> Iterator[Row]:
    pair, seen = _pair(), _seen()
    good = np.flatnonzero(pair.inlier_mask)
    p1, p2 = pair.pixels1[good], pair.pixels2[good]
    y1, y2 = pair.camera1.unproject(p1), pair.camera2.unproject(p2)
    X, p = seen.points_in_world[seen.inlier_mask], seen.pixels[seen.inlier_mask]
    y = seen.camera.unproject(p)
    yield _row(solvers.solve_p3p, rays_in_cam=y[:3], points_in_world=X[:3])
    yield _row(solvers.solve_p4pf, pixels=p[:4] - 400, points_in_world=X[:4])
    origins = 0.1 * _some(3, 3)
    yield _row(
        solvers.solve_generalized_p3p, origins_in_rig=origins, rays_in_rig=y[:3], points_in_world=X[:3]
    )
    yield _row(solvers.solve_upright_p2p, rays_in_cam=y[:2], points_in_world=X[:2])
    yield _row(solvers.solve_pnp, rays_in_cam=y[:8], points_in_world=X[:8])
    yield _row(solvers.solve_essential_five_point, rays1=y1[:5], rays2=y2[:5])
    yield _row(solvers.solve_upright_relative_three_point, rays1=y1[:3], rays2=y2[:3])
    yield _row(solvers.solve_shared_focal_six_point, pixels1=p1[:6] - 400, pixels2=p2[:6] - 400)
    for function, n in (
        (solvers.solve_fundamental_seven_point, 7),
        (solvers.solve_fundamental_eight_point, 12),
        (solvers.solve_homography_four_point, 4),
        (solvers.solve_homography_dlt, 9),
    ):
        yield _row(function, pixels1=p1[:n], pixels2=p2[:n])
    yield _row(hartley_normalization, pixels=p1)
    yield _row(solvers.FocalPoses, cam_from_world=PLACES, focal_px=np.ones(4))
    yield _row(solvers.SharedFocals, fundamental=_some(4, 3, 3), focal_px=np.ones(4))


def _estimators() -> Iterator[Row]:
    pair, seen = _pair(), _seen()
    matches = {"pixels1": pair.pixels1, "pixels2": pair.pixels2}
    known = matches | {"camera1": pair.camera1, "camera2": pair.camera2}
    seen_points = {"points_in_world": seen.points_in_world, "pixels": seen.pixels}
    options, quality, down = {"config": QUICK}, {"quality": np.arange(40.0)}, np.array([0.0, 1.0, 0.1])
    yield _row(robust.estimate_absolute_pose, **seen_points, camera=seen.camera, **options, **quality)
    yield _row(
        robust.estimate_rig_pose, **seen_points, camera_index=np.arange(40) % 2, cameras=[seen.camera] * 2,
        cams_from_rig=PLACES[:2], **options,
    )  # fmt: skip
    upright = {"down_in_cam": down, "down_in_world": -down}
    yield _row(robust.estimate_upright_pose, **seen_points, camera=seen.camera, **upright, **options)
    center = np.array([640.0, 480.0])
    yield _row(robust.estimate_pose_and_focal, **seen_points, principal_point=center, **options)
    points = {"source": seen.points_in_world, "target": seen.points_in_world + 1.0}
    yield _row(robust.estimate_rigid, **points, **options, **quality)
    yield _row(robust.estimate_similarity, **points, **options, **quality)
    yield _row(robust.estimate_upright_similarity, **points, **options)
    for function, given in (  # in any order: the loop takes another type of argument then
        (robust.estimate_absolute_pose, seen_points | {"camera": seen.camera}),
        (robust.estimate_rigid, points),
        (robust.estimate_similarity, points),
        (robust.estimate_relative_pose, known),
        (robust.estimate_fundamental_matrix, matches),
        (robust.estimate_homography, matches),
    ):
        yield f"{function.__name__} in any order", function, given | options
    yield _row(robust.estimate_motion_and_shared_focal, **matches, principal_point=center, **options)
    centers = {"principal_point1": center, "principal_point2": center}
    yield _row(robust.estimate_motion_and_focals, **matches, **centers, **options)
    yield _row(robust.estimate_relative_pose, **known, **options, **quality)
    yield _row(robust.estimate_upright_motion, **known, down_in_cams=(down, down), **options)
    yield _row(robust.estimate_essential_matrix, **known, **options, **quality)
    yield _row(robust.estimate_fundamental_matrix, **matches, **options, **quality)
    yield _row(robust.estimate_homography, **matches, **options, **quality)
    yield _row(PairMatches, **known, is_calibrated=True, seed=3)
    yield _row(robust.verify_pairs, pairs=[PairMatches(**known), PairMatches(**known)], **options)
    yield _row(robust.verify_pair, **known, is_calibrated=False, **options)


def _triangulation() -> Iterator[Row]:
    points, camera = _some(6, 3) + IN_FRONT, LENS
    for n in (2, 4):
        pixels = np.stack(
            [camera.project(position.apply(points)) for position in (PLACES[k] for k in range(n))]
        )
        views = {"cams_from_world": PLACES[:n], "cameras": [camera] * n}
        name, function, arguments = _row(
            robust.triangulate_points, **views, pixels=pixels, max_error_px=4.0, min_angle_rad=0.01
        )
        yield f"{name} of {n}", function, arguments
    seen = np.ones((4, 6), bool)
    yield _row(robust.point_covariances, **views, points_in_world=points, seen_mask=seen, noise_px=0.5)


def _bundle() -> optim.BundleProblem:
    return mapping.bundle_problem_of(_ring().start)


def _bundles() -> Iterator[Row]:
    problem = _bundle()
    f, c = len(problem.frame_free), len(problem.camera_params)
    quick = BundleConfig(max_iterations=2, loss=Loss.CAUCHY)
    result = optim.adjust_bundle(problem, quick)
    distances = optim.PointDistances(np.array([0, 1]), np.array([2, 3]), np.ones(2), np.ones(2))
    priors = {
        "position_in_world": problem.rig_from_world.centers(),
        "position_sigma": 1.0,
        "rig_from_world": problem.rig_from_world,
        "rig_information": np.tile(np.eye(6), (f, 1, 1)),
        "down_in_rig": np.tile([0.0, 0.6, 0.8], (f, 1)),
        "down_in_world": (0.0, 0.0, -1.0),
        "down_sigma_rad": 0.1,
        "params_expected": problem.camera_params,
        "params_sigma": np.ones((c, 12)),
        "distances": distances,
    }
    fields = {name: getattr(problem, name) for name in problem.__slots__}
    free = {"sensor_free": np.zeros((c, 6)), "priors": BundlePriors(**priors)}
    ends = {name: getattr(distances, name) for name in distances.__slots__}
    yield _row(optim.PointDistances, **ends)
    yield _row(optim.PointPositions, point=np.array([0, 2]), expected=_some(2, 3), sigma=np.ones((2, 3)))
    yield _row(BundlePriors, **priors)
    yield _row(BundlePriors(**priors).check, num_frames=f, num_cameras=c, num_points=20)
    yield _row(optim.BundleProblem, **fields | free)
    tracks = {"image": np.array([0, 1, 0]), "point": np.array([1, 1, 0]), "pixels": np.ones((3, 2))}
    poses = {
        "cams_from_world": problem.rig_from_world[:2],
        "cameras": LENS,
        "points_in_world": np.ones((2, 3)),
    }
    yield _row(optim.BundleProblem.from_tracks, **poses, **tracks)
    yield "adjust_bundle of BundleProblem", _adjusted, fields | free
    yield _row(optim.adjust_bundle, problem=problem, config=quick, progress=lambda _: True)
    yield _row(optim.bundle_covariance, problem=problem, result=result, config=quick, noise_px=0.5)
    along = np.ones(problem.frame_free.shape)
    yield _row(optim.bundle_variance, problem=problem, result=result, derivative=along, config=quick)
    yield _row(optim.with_result, problem=problem, result=result)
    yield _row(optim.with_fixed_gauge, problem=problem)
    which = {"focal": True, "principal_point": False, "distortion": True}
    yield _row(optim.free_params_mask, models=problem.camera_model, **which)
    yield _row(optim.evaluate_loss, loss=Loss.HUBER, squared=_some(5) ** 2, scale=1.0)
    pattern = {"size": np.full(3, 2), "row": np.array([0, 1, 2, 2]), "column": np.array([0, 1, 2, 0])}
    yield _row(BlockPattern, **pattern)
    blocks = np.stack([4.0 * np.eye(2)] * 3 + [np.ones((2, 2))])
    plan = plan_cholesky(BlockPattern(**pattern))
    yield _row(plan_cholesky, pattern=BlockPattern(**pattern), last_mask=np.array([False, False, True]))
    yield _row(plan.factorize, blocks=blocks)


def _adjusted(**fields: Any) -> Any:
    return optim.adjust_bundle(optim.BundleProblem(**fields), BundleConfig(max_iterations=2))


def _graph(kind: type) -> PoseGraph:
    size = {Rigid2: 3, Rigid3: 6, Similarity3: 7}[kind]
    steps, first = kind.exp(0.1 * _some(6, size)), np.array([0, 1, 2, 3, 0, 1])
    second = np.array([1, 2, 3, 4, 4, 3])
    information, fixed = np.tile(np.eye(size), (6, 1, 1)), np.array([2])
    return PoseGraph(kind.exp(0.1 * _some(5, size)), first, second, steps, information, fixed)


def _optimized(**fields: Any) -> Any:
    return optim.optimize_pose_graph(PoseGraph(**fields), PoseGraphConfig(max_iterations=5))


def _pose_graphs() -> Iterator[Row]:
    quick = PoseGraphConfig(max_iterations=5)
    for kind in (Rigid2, Rigid3, Similarity3):
        graph = _graph(kind)
        fields = {name: getattr(graph, name) for name in graph.__slots__}
        yield f"optimize_pose_graph of {kind.__name__}", _optimized, fields
    yield _row(PoseGraph, **fields)
    graph = _graph(Rigid3)
    yield _row(optim.optimize_pose_graph, graph=graph, config=quick, progress=lambda *_: True)
    may_be_wrong = np.array([False] * 4 + [True] * 2)
    yield _row(optim.optimize_pose_graph_robustly, graph=graph, may_be_wrong_mask=may_be_wrong, config=quick)
    yield _row(optim.initialize_pose_graph, graph=graph)
    yield _row(optim.pose_graph_cost, graph=graph)
    yield _row(g2o.write_g2o, path="/dev/null/no-folder/graph.g2o", graph=graph, ids=np.arange(5) + 7)


def _some_features(n: int, width: int = 128) -> features.Features:
    rng = np.random.default_rng(n)
    pixels = rng.uniform(0, 200, (n, 2)).astype(np.float32)
    ones = np.ones(n, np.float32)
    return features.Features(pixels, ones, ones.copy(), rng.integers(0, 60, (n, width), np.uint8))


def _features() -> Iterator[Row]:
    one, two, F = _some_features(30), _some_features(25), _some(3, 3)
    fields = {name: getattr(one, name) for name in one.__slots__}
    words = _some(8, 128).astype(np.float32)
    yield _row(features.Features, **fields)
    yield _row(features.detect_features, gray=_image(), config=FeatureConfig(max_features=50))
    orb = FeatureConfig(kind="orb", max_features=50)
    yield "detect_features orb", features.detect_features, {"gray": _image(), "config": orb}
    both = {"descriptors1": one.descriptors, "descriptors2": two.descriptors}
    yield _row(features.match_descriptors, **both, config=MatchConfig())
    bits = {"descriptors1": one.descriptors[:, :32].copy(), "descriptors2": two.descriptors[:, :32].copy()}
    yield "match_descriptors of bits", features.match_descriptors, bits | {"config": MatchConfig()}
    guided = {"fundamental": F, "band_px": 3.0, "config": MatchConfig()}
    yield _row(features.match_along_epipolar_lines, features1=one, features2=two, **guided)
    near = {"pixels": _some(len(one), 2), "descriptors": one.descriptors, "features": two}
    yield _row(features.match_near_pixels, **near, radius_px=3.0, config=MatchConfig())
    yield _row(features.describe_image, descriptors=one.descriptors, words=words)
    yield _row(features.describe_images, descriptors=[one.descriptors] * 2, words=words)
    yield _row(features.most_similar, vectors=_some(6, 16).astype(np.float32), count=3)
    lists = [one.descriptors, two.descriptors]
    yield _row(features.train_vocabulary, descriptors=lists, num_words=4, seed=1, rounds=2)
    at = {"pixels": np.array([[30.0, 20.0], [32.0, 24.0]]), "guess": np.array([[30.5, 20.0], [31.0, 24.0]])}
    images = {"first": _image(), "second": _image()}
    yield _row(features.track_points, **images, **at, config=features.FlowConfig(levels=2), and_back=True)
    yield _row(features.align_patches, **images, **at, warps=np.tile(np.eye(2), (2, 1, 1)), half_px=4)
    several = {"images": [_image(), _image()], "image": np.array([1, 0]), "second": _image()}
    bent = np.tile(np.eye(2), (2, 1, 1))
    yield _row(features.align_patches_of_images, **several, **at, warps=bent, half_px=4)
    yield _row(features.find_patches, **images, **at, warps=np.tile(np.eye(2), (2, 1, 1)), levels=2)
    yield _row(features.find_along_rows, **images, pixels=at["pixels"], max_shift=9, half_px=3)
    yield _row(features.root_sift, descriptors=np.abs(words))
    yield _row(features.describe_upright, gray=_image(), pixels=at["pixels"], sigma_px=3.0)


def _imu_log() -> inertial.ImuLog:
    times = np.arange(0.0, 3.3, 0.02)
    gradient = -4.0 * np.sin(2.0 * (times - 0.2))[:, None] * np.array([1.0, 0.5, 0.2]) + np.array(
        [0.0, 0.0, 9.81]
    )
    return inertial.ImuLog(times, np.zeros((len(times), 3)), gradient)


def _inertial() -> Iterator[Row]:
    log, instants = _imu_log(), np.arange(12) * 0.25 + 0.2
    yield _row(
        inertial.ImuLog, timestamp_s=log.timestamp_s, gyro_rad_s=log.gyro_rad_s, accel_m_s2=log.accel_m_s2
    )
    yield _row(inertial.ImuNoise, gyro_density=1e-3)
    bias = {"gyro_bias": np.zeros(3), "accel_bias": np.zeros(3), "noise": inertial.ImuNoise()}
    yield _row(inertial.preintegrate, log=log, instants_s=instants, **bias)
    trajectory = np.sin(2.0 * (instants - 0.2))[:, None] * np.array([1.0, 0.5, 0.2])
    path = geometry.Rigid3(np.tile(np.eye(3), (12, 1, 1)), trajectory)
    unit = inertial.MountedImu(log, geometry.Rigid3.identity())
    options = {"position_sigma": 0.01, "rotation_sigma_rad": 0.01, "is_metric": True}
    yield _row(inertial.align_path_to_imu, timestamp_s=instants, world_from_camera=path, imu=unit, **options)
    yield _row(inertial.MountedImu, log=log, camera_from_imu=geometry.Rigid3.identity(), noise=unit.noise)
    known = {"frames": np.arange(12), "timestamp_s": instants, "world_from_camera": path, "imu": unit}
    aligned = inertial.align_path_to_imu(instants, path, unit, **options)
    yield _row(inertial.imu_factors, **known, aligned=aligned, weight=0.5, is_metric=True)
    yield from _dead_reckoning(log, unit, instants, path, aligned.calibration)
    moving = inertial_path(0, seconds=15.0, rotation_sigma_rad=1e-4)
    seen = {"timestamp_s": moving.timestamp_s, "world_from_camera": moving.world_from_camera}
    yield _row(inertial.fit_imu_clock, **seen, imu=moving.imu(), largest_offset_s=0.1)
    given = {
        "offset_s": 0.01,
        "offset_sigma_s": 0.001,
        "rotation": np.eye(3),
        "rotation_covariance": np.eye(3),
    }
    yield _row(inertial.ImuClock, **given, gyro_bias=np.zeros(3), num_rotations=20)


def _dead_reckoning(
    log: inertial.ImuLog,
    unit: inertial.MountedImu,
    instants: np.ndarray,
    path: geometry.Rigid3,
    calibration: inertial.ImuCalibration,
) -> Iterator[Row]:
    yield _row(inertial.ImuBuffer, log=log)
    values = {"scale": 1.0, "gravity_in_world": np.array([0.0, 0.0, -9.81]), "gyro_bias": np.zeros(3)}
    yield _row(inertial.ImuCalibration, **values, accel_bias=np.zeros(3), covariance=np.eye(10))
    known = {"timestamp_s": instants[:4], "world_from_camera": path[:4], "covariance": 1e-6 * np.eye(6)}
    yield _row(inertial.fit_imu_motion, **known, imu=unit, calibration=calibration)
    motion = inertial.fit_imu_motion(**known, imu=unit, calibration=calibration)
    yield _row(inertial.carry_motion, motion=motion, timestamp_s=float(instants[5]), imu=unit)
    state = {
        "timestamp_s": 0.5,
        "world_from_imu": geometry.Rigid3.identity(),
        "velocity_in_world": np.zeros(3),
    }
    yield _row(inertial.ImuMotion, **state, covariance=np.eye(19), calibration=calibration)


def _image(*channels: int) -> np.ndarray:
    return np.random.default_rng(5).integers(0, 255, (48, 64, *channels), np.uint8)


def _images() -> Iterator[Row]:
    yield _row(image.census, image=_image().astype(np.uint16), window=(5, 5))
    yield _row(image.color_range, values=_some(5, 4))
    yield _row(image.color_map, values=_some(5, 4))
    yield _row(image.gray_image, image=_image(3), white=200.0)
    yield _row(image.downscaled, image=_image(3), max_side_px=20)
    yield _row(image.undistort_points, pixels=np.ones((2, 2)), camera=PINHOLE, pinhole=None)
    yield _row(image.undistorted_camera, camera=LENS)
    yield _row(image.undistort_image, rgb=_image(3), camera=LENS, pinhole=PINHOLE)
    yield _row(image.undistortion_stmap, camera=LENS, pinhole=PINHOLE)
    yield _row(image.distortion_stmap, camera=LENS, pinhole=PINHOLE)


def _columns() -> Iterator[Row]:
    model = _ring().start
    for part in (model, model.cameras, model.rigs, model.frames, model.images, model.points, model.tracks):
        yield _row(type(part), **{name: getattr(part, name) for name in part.__slots__})
    yield _row(scene.Cameras.from_list, cameras=[LENS], is_focal_trusted=[True], is_constant=[False])
    yield _row(scene.Rigs.of_single_cameras, num_cameras=3)
    yield _row(model.images.keypoints_of, image=1)
    yield _row(model.transformed, target_from_world=Similarity3.exp(0.1 * _some(7)))
    yield _row(scene.unregistered, count=3)
    yield _row(scene.Georeference, lat_deg=48.2, lon_deg=11.6, alt_m=520.0, crs="EPSG:32632")
    yield _row(scene.Georeference.about, lat_lon_alt=_some(4, 3), crs="")
    single, small = np.zeros((3, 4), np.float32), np.zeros((3, 4))
    yield _row(scene.DisparityMap, disparity_px=single, sigma_px=single, reason=np.zeros((3, 4), np.uint8))
    yield _row(scene.DepthMap, depth=small, sigma=small, calibration_sigma=small)
    yield _row(scene.Extent, low=-np.ones(3), high=np.ones(3), focus=np.zeros(3), radius=1.0)
    box = scene.extent_of(_some(9, 3), _some(4, 3), 90.0)
    yield _row(box.contains, points_in_world=_some(9, 3))
    curve = scene.Curve("path", _some(5, 2, 3), (10, 20, 30))
    yield _row(scene.Curve, name="path", segments_in_world=_some(5, 2, 3), rgb=(10, 20, 30), is_shown=False)
    yield _row(curve.transformed, target_from_world=Similarity3.exp(0.1 * _some(7)))
    yield _row(scene.path_segments, points_in_world=_some(4, 3), is_joined=np.ones(4, bool))
    yield _row(scene.extent_of, points_in_world=_some(9, 3), centers_in_world=_some(4, 3), percent=90.0)
    yield _row(scene.frustum_corners_in_cam, K=LENS.K, width=64, height=48)
    yield _row(scene.frustum_size, centers_in_world=_some(4, 3), least=0.1, most=1.0)
    yield _row(scene.PointCloud, points_in_cam=_some(12, 3), mask=np.ones((3, 4), bool))
    yield _row(scene.depth_map_to_point_cloud, depth=1.0 + np.abs(_some(5, 4)), K=LENS.K)
    numbers = {"focal_px": 50.0, "cx": 31.5, "cy": 23.5, "baseline": 0.1, "principal_offset_px": 1.0}
    sigmas = {"focal_sigma_px": 0.1, "baseline_sigma": 0.01, "principal_offset_sigma_px": 0.1}
    yield _row(scene.RectifiedRig, **numbers, **sigmas)
    yield _row(scene.RectifiedRig(**numbers).calibration_sigma, disparity_px=single)
    right = Rigid3(np.eye(3), np.array([-0.1, 0.0, 0.0]))
    yield _row(scene.StereoRig, left=LENS, right=LENS, right_from_left=right, covariance=np.eye(30))
    mounted = Rigid3(np.stack([np.eye(3), np.eye(3)]), np.stack([np.zeros(3), right.translation]))
    yield _row(scene.CameraRig, cameras=(LENS, LENS), cam_from_rig=mounted)
    cameras, at = scene.CameraRig((LENS, LENS), mounted), {"camera": np.array([0, 1])}
    yield _row(cameras.camera_of, pixels=np.array([[3.0, 2.0], [3.0, 60.0]]))
    yield _row(cameras.project, points_in_rig=np.array([[0.0, 0.0, 2.0], [0.1, 0.0, 3.0]]), **at)
    yield _row(cameras.sees, pixels=np.array([[3.0, 2.0], [3.0, 60.0]]), margin_px=1.0, **at)
    yield _row(cameras.unproject, pixels=np.array([[3.0, 2.0], [3.0, 60.0]]), **at)
    rig = scene.StereoRig(LENS, LENS, right)
    yield _row(rig.check_image_sizes, left=_image(), right=_image())
    yield _row(rig.perturbed, change=1e-3 * _some(30))
    graph = _view_graph()
    yield _row(scene.ViewGraph, **{name: getattr(graph, name) for name in graph.__slots__})


def _view_graph() -> scene.ViewGraph:
    model = _ring().start
    point, image_of, keypoint = (
        model.tracks.point_of_observation(),
        model.tracks.image,
        model.tracks.keypoint,
    )
    rows = []
    for j in range(len(model.points)):
        own = np.flatnonzero(point == j)
        rows += [(image_of[a], image_of[b], keypoint[a], keypoint[b]) for a, b in pairwise(own)]
    rows.sort(key=lambda row: row[:2])
    pairs = sorted({row[:2] for row in rows})
    counts = [sum(row[:2] == pair for row in rows) for pair in pairs]
    columns = np.array(rows, np.int32)
    n = len(pairs)
    blank = np.full((n, 3, 3), np.nan)
    return scene.ViewGraph(
        *np.array(pairs, np.int32).T.copy(),
        np.ones(n, np.int32),
        np.array(counts, np.int32),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        columns[:, 2].copy(),
        columns[:, 3].copy(),
        Rigid3(blank, np.full((n, 3), np.nan)),
        *(blank, blank.copy(), blank.copy()),
        np.full(n, 0.1),
    )


def _features_of(pixels: np.ndarray) -> features.Features:
    ones = np.ones(len(pixels), np.float32)
    descriptors = np.arange(128 * len(pixels), dtype=np.int64).reshape(-1, 128) % 90
    return features.Features(pixels.astype(np.float32), ones, ones.copy(), descriptors.astype(np.uint8))


def _builder() -> mapping.ModelBuilder:
    model = _ring().start
    lists = [model.images.keypoints_of(i) for i in range(len(model.images))]
    components = mapping.connect_matches(_view_graph(), model.images.keypoint_offsets)
    builder = mapping.ModelBuilder(model.cameras, model.camera_of_image, lists, components)
    positions = model.cams_from_world()
    for i in range(len(lists)):
        builder.register(i, positions[i])
    builder.triangulate(np.arange(len(components)), 100.0, 0.001)
    return builder


def _anchors(model: scene.Reconstruction) -> Iterator[Row]:
    """Scales: of an object before two cameras, of a path, of both; and of a model by its places."""
    sheet = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0]])
    two = Rigid3(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0, 6], [1.0, 0, 6]]))
    pixels = np.stack([PINHOLE.project(two[v].apply(sheet)) for v in range(2)])
    yield _row(
        scale.fit_scale_to_object, points_in_object=sheet, cams_from_world=two, cameras=[PINHOLE, PINHOLE],
        pixels=pixels, sigma_px=0.5, cam_covariance=np.zeros((2, 6, 6)),
    )  # fmt: skip
    times = np.arange(12.0)
    trajectory = np.stack([times, 0 * times, 0 * times], axis=1)
    yield _row(
        scale.fit_scale_to_distances, timestamp_s=times, positions_in_model=trajectory, log_s=times, traveled_m=2 * times,
        positions_by_odometry=None, sigma=0.01, levers_m=0.1 * trajectory,
    )  # fmt: skip
    instants = np.arange(12) * 0.25 + 0.2
    swing = np.sin(2.0 * (instants - 0.2))[:, None] * np.array([1.0, 0.5, 0.2])
    path = geometry.Rigid3(np.tile(np.eye(3), (12, 1, 1)), swing)
    unit = inertial.MountedImu(_imu_log(), geometry.Rigid3.identity())
    yield _row(scale.fit_scale_to_imu, timestamp_s=instants, world_from_camera=path, imu=unit)
    yield _row(scale.check_anchor_files, options=AnchorOptions())
    yield _row(scale.mounted_imu, options=AnchorOptions())
    estimate = {"kind": "tag", "name": "tag 1", "scale": 2.0, "sigma": 0.1, "shared_sigma": 0.01, "note": ""}
    yield _row(scale.ScaleEstimate, **estimate)
    known = scale.ScaleEstimate(**estimate)
    yield _row(scale.agreed_scale, estimates=[known], refusals=["tag 2: not seen"])
    metric = {
        "scale": 2.0,
        "sigma": 0.1,
        "estimates": (known,),
        "kept_mask": np.ones(1, bool),
        "refusals": (),
    }
    yield _row(scale.MetricScale, **metric)
    views = scale.views_of_model(model, lambda _: None)
    yield _row(scale.views_of_model, model=model, image_of=lambda _: None)
    yield _row(scale.AnchorViews, **{name: getattr(views, name) for name in views.__slots__})
    yield _row(scale.position_covariance, model=model, image=1)
    yield _row(scale.anchor_model, views=views, options=AnchorOptions(), path=None, others=[known])
    whole = {
        "world_from_model": Similarity3.identity(),
        "scale": scale.MetricScale(**metric),
        "positions": None,
    }
    yield _row(scale.Anchoring, **whole)
    anchoring, centers = scale.Anchoring(**whole), model.camera_centers_in_world()
    yield _row(scale.after_adjustment, anchoring=anchoring, before=centers, after=2.0 * centers)


def _global(graph: scene.ViewGraph, components: mapping.MatchComponents, num_images: int) -> Iterator[Row]:
    """Rotation averaging and global positioning."""
    pairs = {
        "num_images": 3,
        "image1": np.array([0, 1, 0], np.int32),
        "image2": np.array([1, 2, 2], np.int32),
        "cams2_from_cams1": np.tile(np.eye(3), (3, 1, 1)),
        "weights": np.ones(3),
    }
    yield _row(mapping.average_rotations, **pairs)
    averaged = mapping.average_rotations(**pairs)
    yield _row(mapping.AveragedRotations, **{n: getattr(averaged, n) for n in averaged.__slots__})
    yield _row(
        mapping.choose_tracks,
        components=components,
        is_member=np.ones(num_images, bool),
        per_image=5,
        view_graph=graph,
        per_pair=2,
    )
    ray = np.array([0.0, 0.0, 5.0]) + _some(6, 3)
    seen = {
        "num_images": 3,
        "offsets": np.array([0, 3, 6]),
        "image": np.array([0, 1, 2, 0, 1, 2], np.int32),
        "directions_in_world": ray / np.linalg.norm(ray, axis=1, keepdims=True),
        "seed": 0,
    }
    pairs = {"image1": pairs["image1"], "image2": pairs["image2"], "direction_in_world": np.eye(3)}
    yield _row(mapping.PairDirections, **pairs)
    seen["pairs"] = mapping.PairDirections(**pairs)
    yield _row(mapping.position_globally, **seen)
    placed = mapping.position_globally(**seen)
    yield _row(mapping.GlobalPositions, **{n: getattr(placed, n) for n in placed.__slots__})


def _mapping() -> Iterator[Row]:
    model, graph = _ring().start, _view_graph()
    yield _row(mapping.find_conflicting_points, model=model, matched=np.array([[0, 1]], np.int32))
    conflicts = mapping.find_conflicting_points(model)
    yield _row(mapping.ConflictingPoints, **{n: getattr(conflicts, n) for n in conflicts.__slots__})
    first = np.array([0, 1], np.int32)
    evidence = {"image1": first, "image2": first + 1, "weight": np.array([1.0, -1.0])}
    yield _row(mapping.cluster_images, num_images=3, **evidence)
    pairs = evidence | {"weight": np.array([1.0, 2.0])}
    yield _row(mapping.connected_images, num_images=3, image1=first, image2=first + 1)
    yield _row(mapping.divide_images, num_images=3, **pairs, most=2)
    yield _row(mapping.nearest_outside, part=np.array([0]), num_images=3, **pairs, most=1)
    seen = {"image": np.array([0, 1, 2, 0, 1, 2]), "point": np.array([0, 0, 0, 1, 1, 1])}
    yield _row(mapping.largest_rigid_part, num_images=3, **seen, min_points=2, min_fraction=0.1)
    offsets, builder = model.images.keypoint_offsets, _builder()
    components, freedom = builder.components, mapping.Freedom()
    quick = BundleConfig(max_iterations=2)
    further = mapping.FurtherMatches(*(np.array([k], np.int32) for k in (0, 1, 1, 1)))
    yield _row(mapping.FurtherMatches, **{name: getattr(further, name) for name in further.__slots__})
    yield _row(mapping.connect_matches, view_graph=graph, keypoint_offsets=offsets, further=further)
    has_rotation = np.isfinite(graph.cam2_from_cam1.rotation).all(axis=(1, 2))
    cycles = {"num_images": len(model.images), "has_rotation": has_rotation, "max_angle_rad": 0.2}
    yield _row(mapping.check_rotation_cycles, view_graph=graph, **cycles)
    found = mapping.check_rotation_cycles(graph, **cycles)
    yield _row(mapping.PairConsistency, **{n: getattr(found, n) for n in found.__slots__})
    yield from _global(graph, components, len(model.images))
    parts = {name: getattr(components, name) for name in components.__slots__}
    yield _row(mapping.MatchComponents, **parts)
    lists = [model.images.keypoints_of(i) for i in range(len(model.images))]
    yield _row(
        mapping.ModelBuilder, cameras=model.cameras, camera_of_image=model.camera_of_image, keypoints=lists,
        components=components,
    )  # fmt: skip
    sight = np.array([0.0, 0.0, 5.0]) + _some(6, 3)
    seen = {
        "points_in_world": sight,
        "pixels": PINHOLE.project(sight),
        "camera": PINHOLE,
        "start": Rigid3.identity(),
    }
    deep = {"disparity_px": 6.0 / sight[:, 2], "focal_baseline": 6.0, "sigma_px": 1.0}
    yield _row(mapping.Disparities, **deep)
    spread = np.random.default_rng(5).normal(size=(12, 3))
    yield _row(
        scale.fit_scale_to_positions, positions_in_model=spread, positions_in_world=2.0 * spread, sigma=0.01
    )
    yield from _anchors(model)
    more = {"sigma_px": np.ones(6), "disparities": mapping.Disparities(**deep), "loss_scale": 2.0}
    yield _row(mapping.refine_pose, **seen, **more)
    yield _row(mapping.PositionPriors, positions_in_world=_some(4, 3), sigma=np.ones((4, 3)))
    yield _row(mapping.PosePriors, cams_from_world=Rigid3.identity(4), sigma=0.1, sigma_rad=0.01)
    yield _row(mapping.Freedom, focal=True, principal_point=False, distortion=True)
    priors = mapping.PositionPriors(_some(4, 3), np.ones((4, 3)))
    yield _row(free_params_of, cameras=model.cameras, freedom=freedom)
    yield _row(expected_params, model=builder)
    yield _row(mapping.adjust_all, model=builder, config=quick, freedom=freedom, priors=priors)
    yield _row(mapping.adjust_sample, model=builder, config=quick, freedom=freedom, priors=priors)
    yield _row(mapping.sample_points, model=builder)
    around = {"image": 1, "num_images": 2, "config": quick, "freedom": freedom}
    yield _row(mapping.adjust_around, model=builder, **around)
    yield _row(mapping.median_error_px, model=builder)
    yield _row(mapping.drop_short_tracks, model=builder, min_length=2, min_long=1)
    detected = [_features_of(builder.keypoints[i]) for i in range(len(builder.keypoints))]
    yield _row(
        mapping.find_further_matches, model=builder, features=detected, radius_px=3.0, config=MatchConfig()
    )
    consistency = mapping.MatchConsistency(builder, graph)
    yield _row(mapping.MatchConsistency, model=builder, view_graph=graph)
    yield _row(consistency.fractions, model=builder)
    yield _row(consistency.overall, model=builder)
    yield _row(consistency.num_explained, model=builder)
    yield _row(consistency.of_images, model=builder)
    yield _row(mapping.explained_matches, model=model, view_graph=graph)
    which = np.arange(len(components))
    yield _row(builder.update_rays, camera=0)
    yield _row(builder.camera, index=0)
    yield _row(builder.cam_from_world, image=1)
    yield _row(builder.triangulate, components=which, max_error_px=4.0, min_angle_rad=0.01)
    yield _row(builder.extend, components=which, max_error_px=4.0)
    yield _row(builder.filter, max_error_px=4.0, min_angle_rad=0.01)
    yield _row(builder.points_in_sight, image=1)
    yield _row(builder.freeze, names=["a", "b", "c", "d"], colors=None, timestamps_s=np.arange(4.0))
    whole = {"model": model, "freedom": freedom, "priors": None}
    yield _row(mapping.bundle_problem_of, **whole)
    yield _row(focal_accuracies, model=model)
    yield _row(mapping.adjust_reconstruction, **whole, config=quick, progress=lambda _: True)
    adjusted = optim.adjust_bundle(mapping.bundle_problem_of(_ring().start), quick)
    yield _row(mapping.with_adjustment, model=_ring().start, result=adjusted)
    yield _row(mapping.resect_image, model=builder, image=1, config=QUICK, search_focal=True)
    rows, points = builder.points_in_sight(1)
    camera, xyz, pixels = builder.camera(0), builder.points[points], builder.row_pixel[rows]
    estimate = robust.estimate_absolute_pose(xyz, pixels, camera, QUICK)
    seen = {"points_in_world": xyz, "pixels": pixels, "camera": camera}
    yield _row(mapping.resect_with_focal, **seen, config=QUICK)
    yield _row(mapping.camera_with_focal, camera=camera, factor=1.1)
    yield _row(mapping.refine_resection, **seen, estimate=estimate, focal=True)
    yield from _point_views(model)


def _point_views(model: scene.Reconstruction) -> Iterator[Row]:
    own = {
        "points_in_world": model.points.xyz_in_world,
        "point": model.tracks.point_of_observation().astype(np.int32),
        "image": model.tracks.image,
        "keypoint": model.tracks.keypoint,
    }
    centers = model.camera_centers_in_world()
    views = mapping.PointViews.of(centers_in_world=centers, **own)
    yield _row(mapping.PointViews.of, centers_in_world=centers, **own)
    yield _row(mapping.PointViews, **{name: getattr(views, name) for name in views.__slots__})
    yield _row(views.rows_of, image=1)
    yield _row(views.seen_from, center_in_world=centers[0], neighbors=np.array([1, 2]), image=0, scratch=None)


def _disparities() -> Iterator[Row]:
    left, options = _image(), config.DisparityConfig(max_disparity_px=10)
    right = np.roll(left, -3, axis=1)
    yield _row(search.match_stereo, left=left, right=right, config=options)
    yield _row(search.match_with_evidence, left=left, right=right, config=options)
    disparities, evidence = search.match_with_evidence(left, right, options)
    fields = {name: getattr(evidence, name) for name in evidence.__slots__}
    yield _row(uncertainty.MatchEvidence, **fields)
    yield _row(uncertainty.disparity_sigma, evidence=evidence)
    yield _row(uncertainty.cues, evidence=evidence, start=0, stop=10)
    yield _row(uncertainty.roughness, disparity_px=np.nan_to_num(disparities.disparity_px))
    yield _row(uncertainty.score, of=uncertainty.cues(evidence))
    coarse = np.zeros((24, 32), np.float32)
    name, function, arguments = _row(
        coarse_to_fine.tiles_of, coarse_px=coarse, shape=(48, 64), search=(0, 20)
    )
    yield name, partial(_listed, function), arguments
    rig = scene.StereoRig(LENS, LENS, Rigid3(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    yield _row(rectification.rectify, rig=rig)
    yield _row(rectification.is_right_of_left, rig=rig)
    rectified = rectification.rectify(rig)
    yield _row(rectified.apply, left=left, right=right)
    fields = {name: getattr(rectified, name) for name in rectified.__slots__}
    yield _row(rectification.Rectification, **fields)
    masks = {"left_valid": np.ones((48, 64), bool), "right_valid": np.ones((48, 64), bool)}
    yield _row(rectification.within_both, disparities=disparities, **masks)


def _listed(function: Callable[..., Any], /, **arguments: Any) -> Any:
    return list(function(**arguments))


def _synthetic() -> Iterator[Row]:
    yard = synthetic.SyntheticScene.of([synthetic.Sphere(center=(0, 5, 0), radius=1.0)])
    yield _row(synthetic.look_at, center=np.zeros(3), target=np.ones(3), up=np.array([0, 0, 1.0]))
    yield _row(synthetic.courtyard)
    yield _row(synthetic.courtyard_views, num_views=3)
    yield _row(synthetic.SyntheticScene, **{name: getattr(yard, name) for name in yard.__slots__})
    position = synthetic.look_at((0, 0, 0), (0, 5, 0))
    yield _row(synthetic.render, scene=yard, camera=PINHOLE, cam_from_world=position, noise_sigma=1.0, seed=1)
    positions = Rigid3(position.rotation[None, None], position.translation[None, None])
    yield _row(synthetic.render_exposures, scene=yard, camera=PINHOLE, cam_from_world=positions, gain=0.9)
    for make in (
        rides.loop_room,
        rides.rotate_only,
        rides.corridor,
        rides.tiled_room,
        rides.walking_box,
    ):
        yield _row(make, num_frames=2, size=(32, 24))
    yield _row(rides.shuttered, num_frames=2, size=(32, 24), readout_s=0.02)
    yield _row(Shutter, readout_s=0.01, exposure_s=0.01, num_exposures=2, noise_sigma=1.0)
    ride = rides.loop_room(2, (32, 24))
    yield _row(ride.left, frame=1)
    yield _row(ride.right, frame=1)
    surface = {
        "color": (0.5, 0.5, 0.5),
        "texture": synthetic.Texture.RICH,
        "seed": 1,
        "tile_m": 0.5,
        "center": (0.0, 5.0, 0.0),
    }
    across = {"direction_u": (1.0, 0.0, 0.0), "direction_v": (0.0, 0.0, 1.0)}
    flat, rolling = {"half_size": (1.0, 1.0)}, {"amplitude": 0.1, "wavelength": 1.0}
    for kind, more in (
        (synthetic.Plane, across | flat),
        (synthetic.Box, {"half_size": (1.0, 1.0, 1.0), "angle_rad": 0.1}),
        (synthetic.Sphere, {"radius": 1.0}),
        (synthetic.HeightField, flat | rolling),
    ):
        yield _row(kind, **surface, **more)
        yield f"render of {kind.__name__}", partial(_rendered, kind), {**surface, **more}
    things = [synthetic.Sphere(center=(0, 5, 0), radius=1.0)]
    yield _row(synthetic.SyntheticScene.of, primitives=things, light=(0.3, -0.5, 0.8))
    two_views = {"num_matches": 20, "outlier_ratio": 0.2, "noise_px": 0.5, "seed": 1}
    more = {"focal_px": 800.0, "size": (640, 480)}
    yield _row(problems.two_view_problem, **two_views, kind="planar", **more)
    yield _row(problems.dominant_plane_problem, **two_views, plane_fraction=0.5)
    seen = {"num_points": 20, "outlier_ratio": 0.2, "noise_px": 0.5, "seed": 1}
    yield _row(problems.absolute_pose_problem, **seen, planar=True, **more)
    counts = {"num_cameras": 4, "num_points": 10, "track_length": 2, "noise_px": 0.5, "seed": 1}
    yield _row(problems.bundle_problem, **counts, model=CameraModel.RADIAL)
    yield _row(look_alike.city_of_like_blocks, seed=1)
    yield _row(look_alike.tiled_room, seed=1)
    yield _row(stereo_rooms.stereo_room, seed=1, size=(48, 36))
    yield _row(stereo_rooms.stereo_street, seed=1, size=(48, 36), focal_px=60.0, baseline=0.1)


def _rendered(kind: type, /, **fields: Any) -> Any:
    position = synthetic.look_at((0, 0, 0), (0, 5, 0))
    return synthetic.render(synthetic.SyntheticScene.of([kind(**fields)]), PINHOLE, position)


def _metrics() -> Iterator[Row]:
    both = {"estimated": PLACES, "truth": Rigid3.exp(0.1 * _some(4, 6, seed=9))}
    yield _row(metrics.align_cameras, **both)
    yield _row(metrics.camera_errors, **both, alignment=metrics.align_cameras(**both))
    found = {"registered_mask": np.array([True, True, True, False])}
    yield _row(metrics.relative_pose_auc, **both, **found, thresholds_deg=(1.0, 5.0))
    yield _row(metrics.relative_pose_errors_deg, **both, **found)
    paths = {"estimate": both["estimated"], "truth": both["truth"]}
    yield _row(metrics.absolute_error, **paths, alignment="similarity")
    yield _row(metrics.relative_error, **paths, step=1, all_pairs=True)
    yield _row(metrics.drift_per_length, **paths, lengths_m=(0.1, 0.2), every=1)
    columns = {"timestamp_s": np.arange(4.0), "world_from_body": PLACES}
    timed = scene.Trajectory(**columns, covariance=np.tile(np.eye(6), (4, 1, 1)))
    yield _row(scene.Trajectory, **columns, covariance=timed.covariance)
    yield _row(metrics.associate, estimate=timed, truth=timed, max_difference_s=0.1)
    yield _row(metrics.score_trajectory, estimate=timed, truth=timed, max_difference_s=0.1)
    yield _row(metrics.ErrorStatistics, values=_some(5))
    yield _row(metrics.area_under_recall, errors=np.abs(_some(6)), thresholds=(1.0, 5.0))


def _options() -> Iterator[Row]:
    kinds = (
        FeatureConfig,
        features.FlowConfig,
        MatchConfig,
        RansacConfig,
        config.DisparityConfig,
        MapperConfig,
    )
    for kind in (*kinds, BundleConfig, PoseGraphConfig):
        yield _row(kind, **{name: getattr(kind(), name) for name in kind.__dataclass_fields__})
