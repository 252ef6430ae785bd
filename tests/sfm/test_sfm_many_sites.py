"""Several sites in one folder: each becomes a model, and what is left is said."""

from types import SimpleNamespace

import numpy as np
import pytest

from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.mapping_stage import reasons_in_words
from epipole.pipelines.sfm.notes import _unmapped_warnings
from epipole.pipelines.sfm.page.content import MAX_IMAGES_SHOWN, _pictured, _used_keypoints
from epipole.robust import PairKind
from epipole.synthetic.problems import bundle_problem

pytestmark = pytest.mark.usefixtures("unchecked")


class Named:
    """Images of which only the names count."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names, self.left_out, self.mask_fingerprints = names, {}, ("",) * len(names)

    def __len__(self) -> int:
        return len(self.names)


def left_solution(num_models: int) -> SimpleNamespace:
    """Two models of images 0 to 5; images 6 to 9 match each other, image 10 only one of a model."""
    rows = [np.arange(11) // 3 == k for k in range(2)]
    models = [SimpleNamespace(is_registered=lambda own=own: own) for own in rows[:num_models]]
    first, second = np.array([0, 3, 6, 7, 8, 0]), np.array([1, 4, 7, 8, 9, 10])
    kind = np.full(6, PairKind.GENERAL)
    graph = SimpleNamespace(image1=first, image2=second, kind=kind)
    return SimpleNamespace(mapped=SimpleNamespace(models=tuple(models), rejections={}), view_graph=graph)


def test_images_of_further_sites_are_said() -> None:
    solution, config = left_solution(2), MapperConfig(max_models=2)
    (warning,) = _unmapped_warnings(solution, config)
    assert "ended after 2 models, but 4 of the other images" in warning and "--mapper.max-models" in warning
    assert not _unmapped_warnings(solution, MapperConfig(max_models=3))
    images = Named(tuple(f"{k}.jpg" for k in range(11)))
    keypoints = [np.zeros((500, 2))] * 11
    none = SimpleNamespace(image1=np.zeros(0, int), image2=np.zeros(0, int))
    given = (images, solution.mapped, solution.view_graph, none, keypoints)
    reasons = reasons_in_words(*given, config)
    assert "ended after 2 models" in reasons["6.jpg"] and "no point of the model" in reasons["10.jpg"]
    assert reasons_in_words(*given, MapperConfig(max_models=3))["6.jpg"] == (
        "its matches belong to no point of the model"
    )


def test_the_report_shows_some_of_many_images() -> None:
    names = tuple(f"{k}.jpg" for k in range(10_000))
    is_registered = np.ones(10_000, bool)
    is_registered[[5, 9_000]] = False
    shown = _pictured(names, is_registered)
    assert {"5.jpg", "9000.jpg"} <= shown and 0.9 * MAX_IMAGES_SHOWN < len(shown) <= MAX_IMAGES_SHOWN
    assert _pictured(names[:400], is_registered[:400]) == set(names[:400])
    assert len(_pictured(names, np.zeros(10_000, bool))) <= MAX_IMAGES_SHOWN


def test_keypoints_of_each_image() -> None:
    model = bundle_problem(6, 100, 4).truth
    found = _used_keypoints(model)
    assert len(found) == 6
    for i, rows in enumerate(found):
        np.testing.assert_array_equal(rows, model.tracks.keypoint[model.tracks.image == i])
