"""Poses that are known approximately give a model its coordinates and scale; wrong ones do not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from photographs import neighboring_views

from epipole import AnchorOptions, reconstruct
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Rotation3, Similarity3, align_points
from epipole.io import write_transforms
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.known_poses import KnownPoses, contradiction_with_poses, fit_known_poses
from mapping_graphs import graph_of_rotations
from whole import IS_WHOLE

SIGMA, SIGMA_DEG = 0.02, 0.5
KNOWN_FROM_MODEL = Similarity3(
    np.array(3.7), Rotation3.exp([0.3, -1.1, 0.6]).matrix, np.array([10.0, -4.0, 2.0])
)


def path_of(kind: str, count: int = 20) -> Rigid3:
    """cam_from_model along a line or a winding path, with different rotations."""
    rng, t = np.random.default_rng(3), np.linspace(0.0, 1.0, count)
    centers = {"line": np.outer(t, [3.0, 1.0, 0.5]), "winding": np.c_[3 * np.cos(4 * t), np.sin(7 * t), t]}[
        kind
    ]
    rotation = Rotation3.exp(rng.normal(0.0, 0.5, (count, 3))).matrix
    return Rigid3(rotation, -(rotation @ centers[..., None])[..., 0])


def known_of(model: Rigid3, rng: np.random.Generator | None = None) -> KnownPoses:
    poses = KNOWN_FROM_MODEL.move_cam_from_source(model)
    if rng is not None:
        noise = rng.normal(0.0, 1.0, (len(model.translation), 6)) * np.repeat(
            [SIGMA, np.deg2rad(SIGMA_DEG)], 3
        )
        poses = Rigid3.exp(noise) @ poses
    return KnownPoses(poses, SIGMA, np.deg2rad(SIGMA_DEG))


@pytest.mark.parametrize("kind", ["line", "winding"])
def test_exact_poses_give_the_similarity_that_made_them(kind):
    model = path_of(kind)
    found = fit_known_poses(model, known_of(model), 0)
    assert found is not None and found.kept.all()
    np.testing.assert_allclose(found.known_from_model.scale, 3.7, rtol=1e-9)
    np.testing.assert_allclose(found.known_from_model.rotation, KNOWN_FROM_MODEL.rotation, atol=1e-9)
    np.testing.assert_allclose(found.known_from_model.translation, KNOWN_FROM_MODEL.translation, atol=1e-8)


@pytest.mark.parametrize("kind", ["line", "winding"])
def test_wrong_poses_have_no_say(kind, rng):
    """Six of twenty are meters or tens of degrees off."""
    model = path_of(kind)
    known = known_of(model, rng)
    off = np.zeros((20, 6))
    off[:3, 0], off[3:6, 4] = 5.0, 0.6
    wrong = KnownPoses(Rigid3.exp(off) @ known.cams_from_world, known.sigma_m, known.sigma_rad)
    found = fit_known_poses(model, wrong, 0)
    assert found is not None
    np.testing.assert_array_equal(found.kept, np.arange(20) >= 6)
    np.testing.assert_allclose(found.known_from_model.scale, 3.7, rtol=0.01)


def test_rotations_of_a_degree_serve_over_hundreds_of_meters(rng):
    """A rotation that is off by its standard deviation moves the far end by more than the positions may be off."""
    model, sigma_rad = path_of("winding", 40), np.deg2rad(1.0)
    large = Similarity3(np.array(100.0), np.eye(3), np.zeros(3)).move_cam_from_source(model)
    noise = rng.normal(0.0, 1.0, (40, 6)) * np.repeat([0.05, sigma_rad], 3)
    found = fit_known_poses(model, KnownPoses(Rigid3.exp(noise) @ large, 0.05, sigma_rad), 0)
    assert found is not None and found.num_kept >= 38
    assert abs(float(found.known_from_model.scale) / 100.0 - 1.0) < 1e-3


def test_the_scale_is_within_its_standard_deviation():
    """The stated deviation is that of positions with this noise."""
    model, rng, scores = path_of("winding"), np.random.default_rng(8), []
    for _ in range(200 if IS_WHOLE else 80):
        known = known_of(model, rng)
        found = fit_known_poses(model, known, 0)
        moved = found.known_from_model.move_cam_from_source(model)
        sigma = found.after(moved, known).scale(moved, known).sigma
        scores.append((float(found.known_from_model.scale) / 3.7 - 1.0) / sigma)
    assert 0.75 < np.std(scores) < 1.15 and abs(np.mean(scores)) < 0.25


def test_poses_of_another_scene_or_too_near_each_other_are_not_used(rng):
    model = path_of("winding")
    other = Rigid3(Rotation3.exp(rng.normal(0, 1, (20, 3))).matrix, rng.normal(0, 5, (20, 3)))
    assert fit_known_poses(model, KnownPoses(other, SIGMA, 0.01), 0) is None
    near = known_of(model)
    assert fit_known_poses(model, KnownPoses(near.cams_from_world, 10.0, 0.01), 0) is None
    few = near.cams_from_world.translation.copy()
    few[2:] = np.nan
    assert (
        fit_known_poses(model, KnownPoses(Rigid3(near.cams_from_world.rotation, few), SIGMA, 0.01), 0) is None
    )


def test_pairs_that_contradict_the_poses():
    """One pair shows something else; the wrong pose of another image contradicts all of its pairs, which stay."""
    poses = path_of("winding", 6)
    pairs = [(i, j) for i in range(6) for j in range(i + 1, 6)]
    rotation = np.array([poses.rotation[j] @ poses.rotation[i].T for i, j in pairs])
    rotation[pairs.index((0, 3))] = Rotation3.exp([0.0, 1.5, 0.0]).matrix @ rotation[pairs.index((0, 3))]
    graph = graph_of_rotations(pairs, rotation, [60] * len(pairs))
    wrong = poses.rotation.copy()
    wrong[5] = Rotation3.exp([0.0, 1.0, 0.0]).matrix @ wrong[5]
    known = KnownPoses(Rigid3(wrong, poses.translation), SIGMA, np.deg2rad(SIGMA_DEG))
    angle = contradiction_with_poses(graph, known, np.deg2rad(10.0))
    assert [pairs[k] for k in np.flatnonzero(np.isfinite(angle))] == [(0, 3)]
    assert np.nanmax(angle) == pytest.approx(1.5)


NOISE, NOISE_DEG = 0.01, 0.2


@pytest.fixture
def poses_file(reconstructed, tmp_path):
    """Poses of the photographs in meters, with noise and one of them wrong, as another program writes them."""
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 1, (6, 6)) * np.repeat([NOISE, np.deg2rad(NOISE_DEG)], 3)
    noise[1, 4] = 0.5
    return write_poses(reconstructed.model, Rigid3.exp(noise) @ neighboring_views(6), tmp_path)


def write_poses(model, cams_from_world: Rigid3, folder):
    path = folder / "poses" / "transforms.json"
    path.parent.mkdir()
    posed = replace(model, frames=replace(model.frames, rig_from_world=cams_from_world), georeference=None)
    write_transforms(posed, path, "images")
    return path


@pytest.mark.usefixtures("unchecked")
def test_a_model_in_the_coordinates_of_the_poses(rendered, out_of_six, poses_file):
    options = {"known_poses": poses_file, "known_poses_sigma_m": NOISE, "known_poses_sigma_deg": NOISE_DEG}
    found = reconstruct(rendered, out_of_six, **options)
    off = found.model.camera_centers_in_world() - neighboring_views(6).centers()
    assert np.linalg.norm(off, axis=1).max() < 4 * NOISE
    summary = found.summary
    assert summary["is_metric"] and "poses" in summary["scale"]
    assert summary["poses"]["num_used"] == 5 and summary["poses"]["not_used"] == ["view_01.jpg"]
    assert any("contradict the model" in words and "view_01.jpg" in words for words in found.warnings)
    true = neighboring_views(6).centers()
    scale = align_points(found.model.camera_centers_in_world(), true).scale
    assert abs(float(scale) - 1.0) < 3 * summary["anchor"]["relative_sigma"]


@pytest.mark.usefixtures("unchecked")
def test_poses_of_another_convention_are_refused_in_words(rendered, reconstructed, out_of_six, tmp_path):
    """Axes that look backward, as from a file with OpenGL's cameras that says it has OpenCV's."""
    turned = Rigid3.exp([0, 0, 0, np.pi, 0, 0]) @ neighboring_views(6)
    upside = Rigid3(np.swapaxes(turned.rotation, 1, 2), turned.translation)
    found = reconstruct(rendered, out_of_six, known_poses=write_poses(reconstructed.model, upside, tmp_path))
    assert found.model.is_registered().all() and not found.summary["is_metric"]
    assert any("the known poses are not used" in words for words in found.warnings)


def test_poses_of_other_images_are_an_error(rendered, reconstructed, tmp_path):
    names = tuple(f"other_{n}.jpg" for n in range(6))
    model = replace(reconstructed.model, images=replace(reconstructed.model.images, name=names))
    path = write_poses(model, neighboring_views(6), tmp_path)
    with pytest.raises(FileFormatError, match=r"a pose for 0 of the 6 images.*other_0.jpg"):
        reconstruct(rendered, tmp_path / "out", known_poses=path)


def test_options_that_exclude_each_other():
    with pytest.raises(ConfigError, match="grow"):
        ReconstructConfig(known_poses=Path("a"), grow=True)
    with pytest.raises(ConfigError, match="known_poses_sigma_m must be positive"):
        ReconstructConfig(known_poses_sigma_m=0.0)
    for other in ({"rigs": Path("b")}, {"anchors": AnchorOptions(positions=Path("c"))}):
        with pytest.raises(ConfigError, match="known_poses cannot be combined with"):
            ReconstructConfig(known_poses=Path("a"), **other)


@pytest.mark.usefixtures("unchecked")
def test_poses_up_to_scale_give_no_meters(rendered, out_of_six, reconstructed):
    found = reconstruct(rendered, out_of_six, known_poses=reconstructed.out, known_poses_sigma_m=0.01)
    assert found.summary["poses"]["num_used"] == 6 and not found.summary["is_metric"]
    assert any("up to scale, and so is this one" in words for words in found.warnings)
    off = found.model.camera_centers_in_world() - reconstructed.model.camera_centers_in_world()
    assert np.linalg.norm(off, axis=1).max() < 0.01
