"""A changed set of images repeats the work on the changed images only, and gives what a fresh run gives."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path

import pytest

from epipole import ReconstructionResult, reconstruct
from epipole.pipelines.sfm.matching import feature_stage, match_stage, pair_blocks

Counts = Counter


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

    monkeypatch.setattr(feature_stage, "detect_features", counted("pictures", detect))
    monkeypatch.setattr(match_stage, "match_pair", counted("matched", match))
    monkeypatch.setattr(
        match_stage, "verify_pairs", counted("verified", verify, lambda pairs, *_: len(pairs))
    )
    monkeypatch.setattr(pair_blocks, "MOST_BLOCKS", 4)
    return counts


@pytest.fixture
def images(rendered: Path, tmp_path: Path) -> Path:
    """Four of the six rendered images, without the first."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    for path in sorted(rendered.iterdir())[1:5]:
        shutil.copy(path, folder / path.name)
    return folder


def assert_as_fresh(result: ReconstructionResult, images: Path, tmp_path: Path) -> None:
    """The same model, points, images, and files of work as a run that began with these images."""
    assert_same_files(result.out, reconstruct(images, tmp_path / "fresh").out)


def assert_same_files(one: Path, two: Path) -> None:
    for root, other in ((one, two), (two, one)):
        for path in [
            *(root / "sparse").rglob("*.bin"),
            *(root / "work").rglob("*/*.npz"),
            root / "points.ply",
        ]:
            name = path.relative_to(root)
            assert (other / name).read_bytes() == path.read_bytes(), name


def test_one_picture_more_before_all_others(
    work: Counts, images: Path, rendered: Path, tmp_path: Path
) -> None:
    reconstruct(images, tmp_path / "out")
    assert work == {"pictures": 4, "matched": 6, "verified": 6}
    first = sorted(rendered.iterdir())[0]
    shutil.copy(first, images / first.name)
    work.clear()
    result = reconstruct(images, tmp_path / "out")
    assert work == {"pictures": 1, "matched": 4, "verified": 4}
    assert result.summary["num_registered"] == 5
    assert_as_fresh(result, images, tmp_path)


def test_one_picture_less_and_one_renamed(work: Counts, images: Path, tmp_path: Path) -> None:
    reconstruct(images, tmp_path / "out")
    names = sorted(path.name for path in images.iterdir())
    (images / names[1]).unlink()
    (images / names[3]).rename(images / "z.jpg")  # the last as before
    work.clear()
    result = reconstruct(images, tmp_path / "out")
    assert not work
    assert_as_fresh(result, images, tmp_path)
    (images / "z.jpg").rename(images / "a.jpg")  # the first now: its pairs are the other way round
    work.clear()
    assert_as_fresh(reconstruct(images, tmp_path / "out"), images, tmp_path / "again")
    assert work["pictures"] <= 3 and work["matched"] == 2 + 3  # with those of the fresh run


def test_the_same_pictures_copied_again(work: Counts, images: Path, tmp_path: Path) -> None:
    """A new folder at the old place, with new times."""
    out = reconstruct(images, tmp_path / "out").out
    shutil.copytree(out, tmp_path / "first")
    images.rename(tmp_path / "earlier")
    shutil.copytree(tmp_path / "earlier", images, copy_function=shutil.copy)
    work.clear()
    reconstruct(images, out)
    assert not work
    assert_same_files(out, tmp_path / "first")


def test_another_option_and_back_leaves_no_files_behind(work: Counts, images: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"

    def files() -> list[str]:
        return sorted(path.name for path in (out / "work").rglob("*.npz"))

    reconstruct(images, out)
    before = files()
    reconstruct(images, out, max_features=1500)
    assert len(files()) == len(before) and set(files()) & set(before) == {"contents.npz"}
    work.clear()
    reconstruct(images, out)
    assert work["pictures"] == 4 and files() == before
