"""The small figures of the pages on models, bundle adjustment, pipelines, failures and fields, against the library."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from tests.lesson.test_lesson_bundle import problem_of
from tests.lesson.test_lesson_failures import RECORD as FAILURES
from tests.lesson.test_lesson_failures import rms_cm, stated
from tests.lesson.test_lesson_fields import RECORD as FIELDS
from tests.lesson.test_lesson_fields import summed

from epipole.cameras import Camera
from epipole.fields.splat._projection_kernels import covariance_of, derivative_of_image, seen_covariance
from epipole.geometry import Rigid2, Rigid3, Rotation3
from epipole.geometry.epipolar import (
    epipolar_lines,
    essential_from_cam2_from_cam1,
    fundamental_from_essential,
)
from epipole.geometry.homogeneous import point_line_distance
from epipole.lesson.scenes import nearest_descriptors, orbit, ring
from epipole.optim import (
    BundleConfig,
    Loss,
    PoseGraph,
    PoseGraphConfig,
    adjust_bundle,
    evaluate_loss,
    optimize_pose_graph,
)
from epipole.robust import estimate_relative_pose
from epipole.solvers import solve_homography_dlt

CAMERA = Camera("PINHOLE", 640, 480, [520.0, 520.0, 319.5, 239.5])


def called(tab, expression):
    """The value of an expression on the page that is open."""
    return tab.page.evaluate(f"() => {expression}")


def motion(given):
    return Rigid3(np.array(given["R"]), np.array(given["t"]))


def test_a_homography_maps_a_plane_exactly_and_nothing_else(tab):
    tab.open("07_models.html")
    side = motion(called(tab, "SIDE"))
    for tilt, lift in ((20.0, 0.7), (-35.0, -0.9), (0.0, 0.0)):
        tab.set(tilt=tilt, lift=lift)
        shown, given = tab.shown(), called(tab, f"planeNumbers({{ tilt: {tilt}, lift: {lift} }})")
        points, off = np.array(given["points"]), np.array(given["off"])
        H = solve_homography_dlt(CAMERA.project(points), CAMERA.project(side.apply(points)))
        x = H @ [*CAMERA.project(off[None])[0], 1.0]
        parallax = np.linalg.norm(x[:2] / x[2] - CAMERA.project(side.apply(off[None]))[0])
        assert shown["on"] == pytest.approx(0.0, abs=1e-9)
        assert shown["beside"] == pytest.approx(parallax, rel=1e-6, abs=1e-6)
        assert (shown["beside"] > 1.0) == (lift != 0.0)


def test_a_rotation_moves_all_depths_alike(tab):
    tab.open("07_models.html")
    for yaw in (-12.0, 0.0, 7.0):
        found = called(tab, f"flowNumbers({{ rx: 0, ry: {yaw} }})")
        assert [found["near"], found["far"]] == pytest.approx([0.0, 0.0], abs=1e-9)
    found = called(tab, "flowNumbers({ rx: 0.3, ry: 0 })")
    for point in ("nearest", "farthest"):
        flow = found[point]
        assert flow["from"][0] - flow["to"][0] == pytest.approx(520.0 * 0.3 / flow["depth"])


def test_a_plane_leaves_the_epipole_open(tab):
    tab.open("07_models.html")
    for eu, ev in ((150.0, 60.0), (-200.0, 500.0), (900.0, 100.0)):
        most = called(tab, f"pencilNumbers({{ eu: {eu}, ev: {ev} }}).most")
        assert most["on"] == pytest.approx(0.0, abs=1e-8) and most["off"] > 3.0
    truth = called(tab, "pencilNumbers({ eu: 0, ev: 0 }).epipole")
    found = called(tab, f"pencilNumbers({{ eu: {truth[0]!r}, ev: {truth[1]!r} }})")
    assert found["most"]["off"] == pytest.approx(0.0, abs=1e-8)
    aside = motion(called(tab, "ASIDE"))
    F = fundamental_from_essential(essential_from_cam2_from_cam1(aside), CAMERA.K, CAMERA.K)
    points = np.array(called(tab, "[...WALL_POINTS, ...BESIDE_POINTS]"))
    lines = epipolar_lines(F, CAMERA.project(points))
    assert point_line_distance(np.array([truth]), lines) == pytest.approx(np.zeros(len(points)), abs=1e-8)


def test_residuals_change_only_where_a_camera_or_a_point_is_displaced(tab):
    tab.open("08_bundle.html")
    still, camera, point = (
        called(tab, f"insetNumbers({{ by_camera: {a}, by_point: {b} }})")
        for a, b in ((0, 0), (0.2, 0), (0, 0.2))
    )
    assert [camera["rms"][k] == still["rms"][k] for k in range(3)] == [True, False, True]
    for k in range(3):
        changed = [a != b for a, b in zip(point["images"][k], still["images"][k], strict=True)]
        assert sum(changed) == 1
    scene = ring()
    shown = scene.cams_from_world[called(tab, "SHOWN[1]")]
    moved = Rigid3(shown.rotation, shown.translation + np.array([0.2, 0.0, 0.0]))
    image = camera["images"][1]
    points = scene.points_in_world[[seen["j"] for seen in image]]
    off = CAMERA.project(moved.apply(points)) - [seen["pixel"] for seen in image]
    assert camera["rms"][1] == pytest.approx(np.sqrt(np.mean(off**2)))


def test_blocks_are_those_of_the_normal_matrix(tab):
    tab.open("08_bundle.html")
    for c, p, k in ((5, 12, 3), (2, 4, 12), (12, 40, 5)):
        found = called(tab, f"arrowNumbers({{ c: {c}, p: {p}, k: {k} }})")
        J = np.zeros((found["rows"], found["all"]))
        for row, column, height, width in [*found["J"]["one"], *found["J"]["point"]]:
            J[row : row + height, column : column + width] = np.random.default_rng(row).normal(
                size=(height, width)
            )
        H = np.zeros((found["all"], found["all"]), bool)
        for row, column, height, width in itertools.chain(*found["H"].values()):
            H[row : row + height, column : column + width] = True
        assert np.array_equal(J.T @ J != 0, H) and np.linalg.matrix_rank(J) <= found["all"]
        assert [found["filled"]["J"], found["filled"]["H"]] == pytest.approx(
            [100 * np.mean(J != 0), 100 * H.mean()]
        )


def test_costs_of_a_step_are_those_of_the_page(tab):
    tab.open("08_bundle.html")
    for many, each in ((10, 10), (30, 20)):
        found = called(tab, f"workNumbers({{ many: {many}, each: {each} }})")
        counted = called(
            tab,
            f"operations({{ U: Array({many + 1}), V: Array({many * each}), W: Array({many * each}).fill(Array(TRACK)) }})",
        )
        assert [found["dense"], found["schur"]] == pytest.approx([counted["whole"], counted["reduced"]])


def test_the_pull_is_the_derivative_of_the_loss(tab):
    tab.open("08_bundle.html")
    r, step = np.linspace(0.1, 20.0, 9), 1e-6
    for scale in (0.5, 1.0, 5.0):
        for name, loss in (("squared", Loss.TRIVIAL), ("cauchy", Loss.CAUCHY)):
            above, below = (evaluate_loss(loss, (r + sign * step) ** 2, scale) for sign in (1, -1))
            pull = called(tab, f"{r.tolist()}.map(r => PULLS.{name}(r, {scale}))")
            assert pull == pytest.approx((above - below) / (4 * step), rel=1e-6)


def test_the_ratio_test_keeps_what_lies_below_the_line(tab):
    tab.open("09_pipeline.html")
    nearest, second, is_right = nearest_descriptors().T
    for ratio in (0.4, 0.8, 1.0):
        kept = nearest < ratio * second
        counts = {"kept": kept.sum(), "right": (kept * is_right).sum(), "lost": (~kept * is_right).sum()}
        found = called(tab, f"ratioNumbers({{ ratio: {ratio} }})")
        assert {name: found[name] for name in counts} == counts
    precise = [
        called(tab, f"(n => n.right / n.kept)(ratioNumbers({{ ratio: {r} }}))") for r in (0.5, 0.8, 1.0)
    ]
    assert precise[0] > precise[1] > precise[2]


def model_of(tab, stage, s):
    return called(
        tab,
        f"""(state => ({{cameras: state.cameras, points: [...state.points], mean: state.mean,
            pixels: state.pixels.map(seen => seen.map(pixel => pixel || [NaN, NaN]))}}))(reconstructed({stage}, {s}))""",
    )


def seen_pixels(scene, model):
    """(c, p, 2) what the page observes; NaN where a point is not visible."""
    pixels = np.array(model["pixels"], float)
    assert pixels.shape[:2] == (len(scene.cams_from_world), len(scene.points_in_world))
    return pixels


def test_stages_of_a_model_have_the_errors_that_the_page_shows(tab):
    tab.open("09_pipeline.html")
    scene = orbit()
    for stage in range(7):
        tab.set(stage=stage + 1, s=0.5)
        shown, model = tab.shown(), model_of(tab, stage, 0.5)
        rows = [j for j, _ in model["points"]]
        assert [shown["registered"], shown["triangulated"]] == [len(model["cameras"]), len(rows)]
        if not rows:
            continue
        points, pixels = np.array([point for _, point in model["points"]]), seen_pixels(scene, model)
        off = [
            np.linalg.norm(CAMERA.project(motion(camera).apply(points)) - pixels[c, rows], axis=1)
            for c, camera in enumerate(model["cameras"])
        ]
        assert shown["mean"] == pytest.approx(np.nanmean(off))
    for s in (0.5, 1.0, 2.0):
        assert called(tab, f"reconstructed(6, {s}).mean") < s < called(tab, f"reconstructed(5, {s}).mean")


def test_the_pair_has_the_pose_of_the_library(tab):
    tab.open("09_pipeline.html")
    scene, model = orbit(), model_of(tab, 1, 0.0)
    first, second = (motion(camera) for camera in model["cameras"])
    for found, true in ((first, scene.cams_from_world[0]), (second, scene.cams_from_world[1])):
        assert found.rotation == pytest.approx(true.rotation, abs=1e-6)
        assert found.translation == pytest.approx(true.translation, abs=1e-6)
    model = model_of(tab, 1, 0.5)
    one, two = seen_pixels(scene, model)[:2]
    both = np.isfinite(one).all(axis=1) & np.isfinite(two).all(axis=1)
    best = estimate_relative_pose(one[both], two[both], CAMERA, CAMERA).model
    found = motion(model["cameras"][1]) @ motion(model["cameras"][0]).inverse()
    assert np.rad2deg(Rotation3(found.rotation @ best.rotation.T).angle_rad()) < 2.0


def test_the_last_stage_ends_where_the_library_ends(tab):
    tab.open("09_pipeline.html")
    scene, before, after = orbit(), model_of(tab, 5, 0.5), model_of(tab, 6, 0.5)
    rows = [j for j, _ in before["points"]]
    pixels = np.swapaxes(seen_pixels(scene, before)[:, rows], 0, 1)
    seen = np.isfinite(pixels).all(axis=2)
    cams = Rigid3(
        np.array([camera["R"] for camera in before["cameras"]]),
        np.array([camera["t"] for camera in before["cameras"]]),
    )
    problem = problem_of(cams, np.array([point for _, point in before["points"]]), seen, pixels)
    found = adjust_bundle(problem, BundleConfig(function_tolerance=0.0))
    points = np.array([point for _, point in after["points"]])
    off = [
        CAMERA.project(motion(camera).apply(points))[seen[:, c]] - pixels[seen[:, c], c]
        for c, camera in enumerate(after["cameras"])
    ]
    assert 0.5 * np.sum(np.concatenate(off) ** 2) == pytest.approx(found.final_cost, rel=1e-6)


def test_a_window_keeps_its_cost(tab):
    tab.open("09_pipeline.html")
    sizes = [called(tab, f"windowNumbers({{ newest: {n}, size: 4 }}).numbers") for n in (8, 12, 16)]
    whole = [found["work_all"] for found in sizes]
    assert whole[0] < whole[1] < whole[2]
    assert max(found["work"] for found in sizes) < 1.5 * min(found["work"] for found in sizes)
    full = called(tab, "windowNumbers({ newest: 12, size: 16 })")
    assert full["numbers"]["unknowns"] == full["numbers"]["unknowns_all"] and not full["fixed"]
    counted = called(tab, "windowNumbers({ newest: 12, size: 4 })")
    keyframes, points = (np.array(called(tab, name)) for name in ("KEYFRAMES", "BESIDE"))
    near = np.linalg.norm(keyframes[:12, None] - points[None], axis=2) < 2.0
    assert counted["numbers"]["unknowns"] == 6 * 4 + 3 * near[8:].any(axis=0).sum()
    assert counted["fixed"] == [k for k in range(8) if (near[k] & near[8:].any(axis=0)).any()]


def test_a_closed_loop_is_that_of_the_library(tab):
    tab.open("09_pipeline.html")
    for drift in (-0.8, 0.0, 1.2):
        found, trip = (called(tab, f"{name}({{ drift: {drift} }})") for name in ("loopNumbers", "roundTrip"))

        def poses(rows):
            x, y, angle = np.array(rows).T
            return Rigid2(angle, np.column_stack([x, y]))

        graph = PoseGraph(
            poses(found["before"]),
            np.array([edge["i"] for edge in trip["edges"]]),
            np.array([edge["j"] for edge in trip["edges"]]),
            poses([edge["motion"] for edge in trip["edges"]]),
            np.array([np.diag(1.0 / np.square(edge["sigmas"])) for edge in trip["edges"]]),
        )
        best = optimize_pose_graph(graph, PoseGraphConfig(relative_tolerance=1e-12))
        after = poses(found["after"])
        assert after.translation == pytest.approx(best.world_from_body.translation, abs=1e-5)
        off = np.linalg.norm(after.translation - np.array(found["truth"])[:, :2], axis=1)
        assert found["numbers"]["after"]["off"] == pytest.approx(np.sqrt(np.mean(off**2)))
        assert found["numbers"]["after"]["gap"] < 0.1 * found["numbers"]["before"]["gap"]


def test_small_replays_show_what_was_recorded(tab):
    tab.open("10_failures.html")
    record = {name: runs for name, runs in FAILURES.items() if name != "kitchen"}
    for failure, runs in record.items():
        tab.set(**{f"at-{failure}": 20})
        said = tab.page.locator(f"#view-{failure}-told").inner_text().split("; ")
        assert len(said) == len(runs)
        for words, run in zip(said, runs.values(), strict=True):
            assert f"{run['points'][20]} points agree" in words
            rejected = sum(verdict == "rejected" for frame, verdict in run["loops"] if frame <= 20)
            assert (f"rejected so far: {rejected}" in words) == (rejected > 0)
            off = rms_cm(stated(run, "final"), run["truth"])
            assert ("position unknown" in words) == np.isnan(off)
            if not np.isnan(off):
                assert float(words.split("final error: ")[1].split(" cm")[0]) == pytest.approx(off, rel=0.005)
    images = tab.page.locator("figure.small image")
    assert images.count() == sum(bool(run["pictures"]) for runs in record.values() for run in runs.values())


def test_fog_is_composited_as_the_field_is(tab):
    tab.open("11_fields.html")
    pixel = FIELDS["pixels"][0]
    distance = pixel["nerf"]["distance"]
    for n in (1, 30, len(distance)):
        for times in (0.05, 1.0, 3.0):
            thickness = [times * v for v in pixel["nerf"]["thickness"]]
            wanted = summed("nerf", {"nerf": {**pixel["nerf"], "thickness": thickness}}, distance[n - 1])
            found = called(tab, f"marchNumbers({{ n: {n}, times: {times} }})")
            assert found["through"] == pytest.approx(wanted["through"])
            assert found["color"] == pytest.approx([wanted[c] for c in ("red", "green", "blue")])


def test_a_splat_has_the_covariance_of_the_library(tab):
    tab.open("11_fields.html")
    view = SimpleNamespace(focal=(520.0, 520.0), rotation=np.eye(3).ravel())
    for long, spin, far in ((0.35, 30.0, 2.4), (0.05, -90.0, 4.0), (0.5, -40.0, 1.6)):
        tab.set(long=long, spin=spin, far=far)
        shown, found = (
            tab.shown(),
            called(tab, f"gaussianNumbers({{ long: {long}, spin: {spin}, far: {far} }})"),
        )
        x, y, z = found["mean"]
        covariance = covariance_of.py_func(np.array(found["axes"]).T.ravel())
        xx, xy, yy = seen_covariance.py_func(derivative_of_image.py_func(view, x / z, y / z, z), covariance)
        assert np.array(found["seen"]) == pytest.approx(np.array([[xx, xy], [xy, yy]]))
        sizes = np.sqrt(np.linalg.eigvalsh(found["seen"]))
        assert [shown["sd_short"], shown["sd_long"]] == pytest.approx(sizes)


def test_the_order_of_two_splats_matters_unless_one_hides_nothing(tab):
    tab.open("11_fields.html")
    inks = called(tab, "INKS")
    for red, blue in ((0.7, 0.7), (0.0, 0.4), (1.0, 0.3)):
        found = called(tab, f"overlaid({{ red: {red}, blue: {blue} }})")
        for front, back, a, b in (("red", "blue", red, blue), ("blue", "red", blue, red)):
            wanted = a * np.array(inks[front]) + (1 - a) * (b * np.array(inks[back]) + (1 - b))
            assert found[front] == pytest.approx(wanted)
    assert (
        called(tab, "overlaid({ red: 0, blue: 0.4 })")["red"]
        == called(tab, "overlaid({ red: 0, blue: 0.4 })")["blue"]
    )
    before = tab.page.locator("#order-told").inner_text()
    tab.page.click("#swap")
    assert tab.page.locator("#order-told").inner_text() != before


def test_costs_of_an_image(tab):
    tab.open("11_fields.html")
    found = called(tab, "costNumbers({ queries: 256, pairs: 56 })")
    assert 580_000 < called(tab, "PER_QUERY") / 2 < 610_000
    assert found["nerf"] == 256 * called(tab, "PER_QUERY") * 640_000
    assert found["splat"] == 56 * FIELDS["operations"]["pair"] * 640_000
    assert found["images"]["nerf"] < 1 < 100 < found["images"]["splat"]
