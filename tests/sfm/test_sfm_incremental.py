"""The incremental mapper alone: exact tracks in, the true cameras out, and a reason for each image that has no place."""

from dataclasses import fields, replace

import numpy as np
import pytest
from sfm_rings import EXACT, errors_of, mapper_of, view_graph_of

from epipole.geometry import Rigid3
from epipole.mapping import ModelBuilder, adjustment, connect_matches
from epipole.pipelines.sfm.mappers.incremental import IncrementalMapper
from epipole.pipelines.sfm.mappers.visible_points import VisiblePoints, spread_score
from epipole.robust import PairKind
from epipole.scene import Reconstruction, ViewGraph
from epipole.synthetic.problems import bundle_problem

pytestmark = pytest.mark.usefixtures("unchecked")  # many small calls, of types that other tests check


def test_exact_tracks_give_the_true_cameras_and_points(ring: Reconstruction, graph: ViewGraph) -> None:
    mapper, given = mapper_of(ring, graph), []
    assert mapper.run(np.ones(12, bool), lambda done, total: given.append((done, total)))
    assert mapper.model.registered.all() and mapper.rejections == {}
    off, rotated = errors_of(mapper, ring)
    assert off.max() < 1e-5 and rotated.max() < 1e-6
    assert given[-1] == (12, 12) and all(total == 12 for _, total in given)
    assert len(mapper.model.living_points()) == len(ring.points)
    assert mapper.consistency.overall(mapper.model) == pytest.approx(1.0)


def test_a_frozen_model_holds_every_observation(ring: Reconstruction, graph: ViewGraph) -> None:
    mapper = mapper_of(ring, graph)
    mapper.run(np.ones(12, bool))
    model = mapper.model.freeze(ring.images.name, None, np.full(12, np.nan))
    assert len(model.tracks.image) == len(ring.tracks.image)
    assert model.mean_reprojection_error_px() < 1e-4


def test_noise_moves_cameras_by_little() -> None:
    """Half a pixel at a focal length of hundreds, seen 75 times an image and more: some thousandths of the radius."""
    noisy = bundle_problem(12, 900, 5, noise_px=0.5, seed=3).truth
    mapper = mapper_of(noisy, view_graph_of(noisy))
    assert mapper.run(np.ones(12, bool)) and mapper.model.registered.all()
    off, rotated = errors_of(mapper, noisy)
    radius = np.linalg.norm(noisy.cams_from_world().centers(), axis=1).mean()
    assert off.max() < 0.005 * radius and np.rad2deg(rotated).max() < 0.3
    assert np.median(off) > 1e-6  # the noise does arrive


def test_what_is_counted_for_one_image_is_that_of_the_whole_model(
    ring: Reconstruction, graph: ViewGraph, rng: np.random.Generator
) -> None:
    """While points come and go: the counts and scores of waiting images, and the agreement of single images, to the last bit."""
    mapper = mapper_of(ring, graph)
    assert mapper.run(np.ones(12, bool))
    model, visible = mapper.model, VisiblePoints(mapper.model)
    for step in range(6):
        seen = model.has_point(np.arange(len(model.components)))[model.row_component]
        visible.update()
        for image, rows in enumerate(model.rows_of_image):
            rows = rows[seen[rows]]
            camera = model.cameras[int(model.camera_of_image[image])]
            assert visible.count(image) == len(rows)
            assert visible.score(image) == spread_score(model.row_pixel[rows], camera.width, camera.height)
            assert mapper.consistency.of_image(model, image) == mapper.consistency.of_images(model)[image]
        some = rng.integers(0, len(model.row_point), 400)
        model.drop(some)
        model.row_point[some[:200]] = rng.integers(0, model.num_points, 200)
        if step == 3:
            model.deregister(5)


def test_filtering_what_has_changed_is_filtering_everything(
    ring: Reconstruction, graph: ViewGraph, rng: np.random.Generator
) -> None:
    mapper = mapper_of(ring, graph)
    assert mapper.run(np.ones(12, bool))
    model, limits, numbers = mapper.model, (2.0, 0.02), []
    model.filter(*limits)
    for step in range(8):
        image = int(rng.integers(12))
        if step % 4 == 0:
            rows = np.flatnonzero(np.isin(model.row_point, rng.integers(0, model.num_points, 30)))
            points = np.unique(model.row_point[rows[model.row_point[rows] >= 0]])
            model.set_points(points, model.points[points] + rng.normal(0, 0.02, (len(points), 3)), rows)
        elif step % 4 == 1 and model.registered[image]:
            model.register(image, Rigid3.exp(rng.normal(0, 1e-3, 6)) @ model.cam_from_world(image))
        elif step % 4 == 2:
            model.deregister(image)
        else:
            params = model.params.copy()
            params[0, 0] *= 1.001
            model.set_params(params)
        before = model.snapshot()
        numbers.append(model.filter(*limits))
        found = model.row_point.copy()
        model.restore(before)  # everything counts as changed
        assert model.filter(*limits) == numbers[-1]
        np.testing.assert_array_equal(model.row_point, found)
        assert model.filter(*limits) == 0
    assert sum(number > 0 for number in numbers) >= 4


def test_only_usable_images_take_part(ring: Reconstruction, graph: ViewGraph) -> None:
    usable = np.ones(12, bool)
    usable[[2, 7]] = False
    mapper = mapper_of(ring, graph)
    assert mapper.run(usable)
    np.testing.assert_array_equal(mapper.model.registered, usable)
    assert errors_of(mapper, ring)[0].max() < 1e-5


def spoilt_image(ring: Reconstruction, image: int, rng: np.random.Generator) -> Reconstruction:
    """The same matches, but the keypoints of one image lie anywhere."""
    first, last = ring.images.keypoint_offsets[image : image + 2]
    pixels = ring.images.keypoints_px.copy()
    camera = ring.cameras[0]
    pixels[first:last] = rng.uniform(0, [camera.width, camera.height], (last - first, 2))
    return replace(ring, images=replace(ring.images, keypoints_px=pixels))


def test_an_image_whose_keypoints_agree_on_no_place_is_rejected_with_its_numbers(
    ring: Reconstruction, graph: ViewGraph, rng: np.random.Generator
) -> None:
    spoilt = spoilt_image(ring, 5, rng)
    mapper = mapper_of(spoilt, graph)
    assert mapper.run(np.ones(12, bool))
    assert np.flatnonzero(~mapper.model.registered).tolist() == [5]
    rejection = mapper.rejections[5]
    assert rejection.image == 5 and rejection.num_points_in_sight > 100
    assert rejection.num_inliers < EXACT.resection_min_ratio * rejection.num_points_in_sight
    assert errors_of(mapper, ring)[0].max() < 1e-5


def test_an_image_that_sees_too_little_is_rejected_with_its_numbers(ring: Reconstruction) -> None:
    """Image 5 keeps fifteen of its matches, where twenty are needed."""
    graph = view_graph_of(ring)
    pair = np.repeat(np.arange(len(graph)), graph.num_inliers())
    of_5 = (graph.image1[pair] == 5) | (graph.image2[pair] == 5)
    own = np.where(graph.image1[pair] == 5, graph.keypoint1, graph.keypoint2)
    few = np.unique(own[of_5])[:15]
    keep = ~of_5 | np.isin(own, few)
    counts = np.bincount(pair[keep], minlength=len(graph))
    thinned = replace(
        graph,
        keypoint1=graph.keypoint1[keep],
        keypoint2=graph.keypoint2[keep],
        match_offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
    )
    mapper = mapper_of(ring, thinned)
    assert mapper.run(np.ones(12, bool))
    assert np.flatnonzero(~mapper.model.registered).tolist() == [5]
    assert mapper.rejections[5].num_points_in_sight == 15 and mapper.rejections[5].num_inliers == 0


@pytest.mark.parametrize("kind", [PairKind.ROTATION, PairKind.NO_MOTION, PairKind.DEGENERATE])
def test_pairs_without_depth_start_nothing(ring: Reconstruction, graph: ViewGraph, kind: PairKind) -> None:
    flat = replace(graph, kind=np.full(len(graph), kind, np.int32))
    mapper = mapper_of(ring, flat)
    assert not mapper.run(np.ones(12, bool))
    assert not mapper.model.registered.any()


def test_two_separate_rings_are_mapped_one_after_the_other(ring: Reconstruction, graph: ViewGraph) -> None:
    """Without the pairs between them, images 0 to 5 and 6 to 11 are two models."""
    half = np.arange(12) < 6
    within = half[graph.image1] == half[graph.image2]
    pair = np.repeat(np.arange(len(graph)), graph.num_inliers())
    counts = graph.num_inliers()[within]
    cut = replace(
        graph,
        **{
            name: getattr(graph, name)[within]
            for name in ("image1", "image2", "kind", "num_putative", "cam2_from_cam1", "essential")
        },
        **{name: getattr(graph, name)[within] for name in ("fundamental", "homography", "median_angle_rad")},
        keypoint1=graph.keypoint1[within[pair]],
        keypoint2=graph.keypoint2[within[pair]],
        match_offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
    )
    first = mapper_of(ring, cut)
    assert first.run(np.ones(12, bool))
    registered = first.model.registered.copy()
    assert registered.sum() == 6 and len(set(half[registered])) == 1
    second = mapper_of(ring, cut)
    assert second.run(~registered)
    np.testing.assert_array_equal(second.model.registered, ~registered)


def test_the_better_spread_points_count_more() -> None:
    """Points over the whole image score higher than as many in a corner, and none score nothing."""
    rng = np.random.default_rng(0)
    spread = rng.uniform(0, [640, 480], (60, 2))
    assert spread_score(spread, 640, 480) > 3 * spread_score(spread / 20, 640, 480) > 0
    assert spread_score(np.zeros((0, 2)), 640, 480) == 0.0
    # One point hits one cell of each level: 4 + 16 + ... + 4096.
    assert spread_score(spread[:1], 640, 480) == sum(4.0**level for level in range(1, 7))


@pytest.mark.parametrize("wrong_by", [0.5, 1.0, 2.0])
def test_the_focal_length_of_a_new_camera_is_found_with_its_place(
    ring: Reconstruction, graph: ViewGraph, wrong_by: float
) -> None:
    """The last image has a camera of its own, of which nothing but a guess is known."""
    truth = float(ring.cameras.params[0, 0])
    columns = {
        field.name: np.concatenate([getattr(ring.cameras, field.name)] * 2) for field in fields(ring.cameras)
    }
    cameras = replace(ring.cameras, **columns)
    cameras.params[1, 0] *= wrong_by
    cameras = replace(cameras, is_constant=np.array([True, False]), is_focal_trusted=np.array([True, False]))
    keypoints = [ring.images.keypoints_of(i) for i in range(12)]
    components = connect_matches(graph, ring.images.keypoint_offsets)
    builder = ModelBuilder(cameras, np.array([0] * 11 + [1], np.int32), keypoints, components)
    mapper = IncrementalMapper(builder, graph, EXACT)
    assert mapper.run(np.ones(12, bool))
    assert builder.registered.all()
    assert builder.params[1, 0] == pytest.approx(truth, rel=1e-3)
    off, rotated = errors_of(mapper, ring)
    assert off.max() < 1e-2 and rotated.max() < 1e-2


def test_observations_around_an_image_are_those_of_the_whole_model(
    ring: Reconstruction, graph: ViewGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The points of an image and its neighbors, with all their rows, grouped by point: as from `rows_by_point`."""
    mapper, seen = mapper_of(ring, graph), []
    assert mapper.run(np.ones(12, bool))
    model = mapper.model
    monkeypatch.setattr(adjustment, "_adjust", lambda *given: seen.append(given))
    for image in range(12):
        adjustment.adjust_around(model, image, 4, mapper._local_bundle(), mapper.freedom())
        _, rows, free, members, *_ = seen.pop()
        own = np.concatenate([model.row_point[model.rows_of_image[i]] for i in free])
        np.testing.assert_array_equal(members, np.unique(own[own >= 0]))
        order, offsets = model.rows_by_point()
        expected = np.concatenate([order[offsets[p] : offsets[p + 1]] for p in members])
        np.testing.assert_array_equal(rows, expected)
        assert len(free) == 4 and free[0] == image
