"""States of trainings that others have made, with a digest that fits: they are refused before a kernel reads them."""

import json

import numpy as np
import pytest
from fields_scenes import views
from fields_trainers import trainer_of

from epipole.errors import EpipoleError, WorkspaceError
from epipole.pipelines.fields.checkpoints import CHECKPOINT, Checkpoint
from epipole.runs.units import store


def restored(kind, folder, change):
    """What comes of a checkpoint whose arrays were changed, and which was sealed again."""
    checkpoint = Checkpoint(folder, {}, views()[:4], trainer_of(kind))
    arrays = {name: np.array(part) for name, part in trainer_of(kind).state().items()}
    arrays |= {"seconds": np.array(1.5), "curve": np.zeros((2, 4))}
    change(arrays)
    store(folder / CHECKPOINT, checkpoint._key, arrays)
    return checkpoint.restore()


@pytest.mark.parametrize("kind", ["splat", "hash", "grid"])
def test_a_state_is_restored(kind, tmp_path):
    assert restored(kind, tmp_path, lambda arrays: None) == (1.5, [[0.0] * 4] * 2)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", ["splat", "hash", "grid"])
def test_every_array_is_checked(kind, tmp_path):
    """Missing, of another length, of another kind; and one that is not known."""
    names = [*trainer_of(kind).state(), "seconds", "curve"]
    for name in names:
        for change in (
            lambda arrays, name=name: arrays.pop(name),
            lambda arrays, name=name: arrays.update({name: arrays[name][None]}),
            lambda arrays, name=name: arrays.update({name: np.zeros(arrays[name].shape, "S1")}),
            lambda arrays, name=name: (
                arrays.update({name: np.zeros(arrays[name].shape, np.complex64)})
                if arrays[name].dtype.kind in "iuf"
                else arrays.pop(name)
            ),
        ):
            with pytest.raises(WorkspaceError, match="is damaged"):
                restored(kind, tmp_path, change)
    with pytest.raises(WorkspaceError, match="is unknown"):
        restored(kind, tmp_path, lambda arrays: arrays.update(other=np.zeros(3)))


def at(name, where, value):
    def change(arrays):
        arrays[name][where] = value

    return change


def grown(*names):
    def change(arrays):
        for name in names:
            arrays[name] = np.concatenate([arrays[name]] * 2)

    return change


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("splat", at("order", ..., 99)),
        ("splat", at("order", ..., -1)),
        ("splat", at("value_means", 0, np.nan)),
        ("splat", at("counts", 0, -1)),
        ("splat", at("pose_rotation", 0, 3.0)),
        ("splat", grown("value_means")),
        ("hash", at("occupied", (0, 0, 0), 200)),
        ("hash", at("counts", 1, 1 << 60)),
        ("hash", at("counts", 1, 0)),
        ("hash", at("value_0", (0, 0, 0), np.inf)),
        ("hash", at("square_1", (0, 0), -1.0)),
        ("grid", at("counts", 1, 1)),
        ("grid", at("counts", 1, 1 << 62)),
        ("grid", at("counts", 2, 5)),
        ("grid", at("occupied", (0, 0, 0), 7)),
        ("grid", at("occupied", ..., 1)),
        ("grid", grown("values", "adam_touched")),
        ("grid", grown("adam_gradient", "adam_mean", "adam_square")),
    ],
)
def test_arrays_that_do_not_fit_each_other_are_refused(kind, change, tmp_path):
    if kind == "splat":
        trainer_of(kind)._next_view()
    with pytest.raises(WorkspaceError, match="delete it and run the command again"):
        restored(kind, tmp_path, change)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[",
        "[1]",
        "{}",
        '{"bit_generator": "MT19937"}',
        json.dumps({"bit_generator": "PCG64", "state": 5}),
    ],
)
def test_a_state_of_random_numbers_is_refused(text, tmp_path):
    with pytest.raises(EpipoleError, match="random generator"):
        restored("hash", tmp_path, lambda arrays: arrays.update(rng=np.array(text)))
