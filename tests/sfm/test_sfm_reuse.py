"""A changed set of images repeats the work on the changed images only, and gives what a fresh run gives."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from epipole import ReconstructionResult, reconstruct
from epipole.pipelines.sfm.matching import feature_stage, match_stage, pair_blocks
from epipole.runs.units import Unit, do_unit
from whole import in_whole_run

Counts = Counter
pytestmark = pytest.mark.usefixtures("unchecked_module")


@pytest.fixture(scope="module")
def stored(rendered: Path, tmp_path_factory: pytest.TempPathFactory, unchecked_module: None) -> Path:
    """A folder to work in, and beside it four of the six rendered images, without the first, with their run."""
    folder = tmp_path_factory.mktemp("reuse") / "now"
    (folder / "images").mkdir(parents=True)
    for path in sorted(rendered.iterdir())[1:5]:
        shutil.copy(path, folder / "images" / path.name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pair_blocks, "MOST_BLOCKS", 4)
        reconstruct(folder / "images", folder / "out")
    folder.rename(folder.with_name("stored"))
    return folder


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> Counts:
    """How many images were searched, and pairs matched and verified, since it was last cleared."""
    counts: Counts = Counter()
    detect, match, verify = feature_stage.detect_features, match_stage.match_pair, match_stage.verify_pairs

    def counted(name, function, size=lambda *_: 1):
        def call(*args, **options):
            counts[name] += size(*args)
            return function(*args, **options)

        return call

    monkeypatch.setattr(feature_stage, "detect_features", counted("images", detect))
    monkeypatch.setattr(match_stage, "match_pair", counted("matched", match))
    monkeypatch.setattr(
        match_stage, "verify_pairs", counted("verified", verify, lambda pairs, *_: len(pairs))
    )
    monkeypatch.setattr(pair_blocks, "MOST_BLOCKS", 4)
    return counts


@pytest.fixture
def images(stored: Path) -> Path:
    """The four images, with the finished run beside them."""
    shutil.rmtree(stored, ignore_errors=True)
    shutil.copytree(stored.with_name("stored"), stored)
    return stored / "images"


def assert_as_fresh(result: ReconstructionResult, images: Path, tmp_path: Path) -> None:
    """The same model, points, images, and features as a run that began with these images."""
    assert_same_files(result.out, reconstruct(images, tmp_path / "fresh").out)


def assert_same_files(one: Path, two: Path) -> None:
    for root, other in ((one, two), (two, one)):
        for path in [
            *(root / "sparse").rglob("*.bin"),
            *(root / "work" / "features").glob("*.npz"),
            root / "points.ply",
        ]:
            name = path.relative_to(root)
            assert (other / name).read_bytes() == path.read_bytes(), name


def pair_files(out: Path) -> list[Path]:
    return [*(out / "work" / "matches").iterdir(), *(out / "work" / "geometry").iterdir()]


@in_whole_run
def test_one_picture_more_before_all_others(
    work: Counts, images: Path, rendered: Path, tmp_path: Path
) -> None:
    first = sorted(rendered.iterdir())[0]
    shutil.copy(first, images / first.name)
    before = {path: path.read_bytes() for path in pair_files(images.parent / "out")}
    result = reconstruct(images, images.parent / "out")
    after = {path: path.read_bytes() for path in pair_files(result.out)}
    assert len(before) == 6 and after.items() >= before.items() and len(after) == 6 + 8
    assert work == {"images": 1, "matched": 4, "verified": 4}
    assert result.summary["num_registered"] == 5
    work.clear()
    assert_as_fresh(result, images, tmp_path)
    assert work == {"images": 5, "matched": 10, "verified": 10}


def test_one_picture_less_and_one_renamed(work: Counts, images: Path, tmp_path: Path) -> None:
    out = images.parent / "out"
    names = sorted(path.name for path in images.iterdir())
    (images / names[1]).unlink()
    (images / names[3]).rename(images / "z.jpg")  # the last as before
    result = reconstruct(images, out)
    assert not work
    assert_as_fresh(result, images, tmp_path)
    (images / "z.jpg").rename(images / "a.jpg")  # the first now: its pairs are the other way round
    work.clear()
    assert_as_fresh(reconstruct(images, out), images, tmp_path / "again")
    assert work["images"] <= 3 and work["matched"] == 2 + 3  # with those of the fresh run


def test_a_file_that_holds_a_key_twice_is_divided_again(tmp_path: Path) -> None:
    """Pairs with two equal pictures have one key; later, one of the two is removed."""

    def match(block: pair_blocks.PairBlock) -> dict[str, np.ndarray]:
        none = np.zeros((0, 2), np.int32)
        return pair_blocks.filled(block, lambda positions: [{"matches": none} for _ in positions])

    def units_of(keys: list[str], blocks: list[range] | None) -> list[Unit]:
        pairs = [(0, n + 1) for n in range(len(keys))]
        return pair_blocks.block_units(
            pairs, keys, tmp_path, match, match_stage.MATCHES, lambda _: None, blocks
        )

    (earlier,) = units_of(["key", "key"], [range(2)])
    do_unit(earlier)
    (later,) = units_of(["key"], None)
    assert later.path != earlier.path and later.payload.blocks == {0: (earlier.path, 1)}


@in_whole_run
def test_the_same_pictures_copied_again(work: Counts, images: Path, tmp_path: Path) -> None:
    """A new folder at the old place, with new times."""
    out = images.parent / "out"
    shutil.copytree(out, tmp_path / "first")
    images.rename(tmp_path / "earlier")
    shutil.copytree(tmp_path / "earlier", images, copy_function=shutil.copy)
    reconstruct(images, out)
    assert not work
    assert_same_files(out, tmp_path / "first")


@in_whole_run
def test_another_option_and_back_leaves_no_files_behind(work: Counts, images: Path) -> None:
    out = images.parent / "out"

    def files() -> list[str]:
        return sorted(path.name for path in (out / "work").rglob("*.npz"))

    before = files()
    reconstruct(images, out, max_features=1500)
    assert len(files()) == len(before) and set(files()) & set(before) == {"contents.npz"}
    work.clear()
    reconstruct(images, out)
    assert work["images"] == 4 and files() == before
