"""Which images are compared: every method against pairs written down by hand."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from epipole.errors import ConfigError, FileFormatError
from epipole.pipelines.sfm.config import PairingConfig
from epipole.pipelines.sfm.matching.pairing import ALL_AT_ONCE, choose_pairs, read_pairs, sorted_pairs

NO_GPS = (np.nan, np.nan, np.nan)


def images_of(subjects: list[int]) -> list[np.ndarray]:
    """Descriptors of images: those of one subject have the same features but for noise."""
    rng = np.random.default_rng(5)
    features = rng.integers(0, 230, (max(subjects) + 1, 150, 128))
    return [(features[s] + rng.integers(0, 20, (150, 128))).astype(np.uint8) for s in subjects]


def positions(meters_north: list[float | None]) -> np.ndarray:
    """Rows (lat, lon, alt) along a meridian."""
    rows = [NO_GPS if m is None else (46.0 + m / 111_150.0, 7.0, 400.0) for m in meters_north]
    return np.array(rows, np.float64)


def chosen(descriptors, lat_lon_alt, *, is_video=False, **options) -> set[tuple[int, int]]:
    """Pairs of both rounds."""
    found = choose_pairs(descriptors, lat_lon_alt, PairingConfig(**options), is_video=is_video)
    out: set[tuple[int, int]] = set()
    for pairs in (found.first, found.later):
        assert pairs.dtype == np.int32 and (pairs[:, 0] < pairs[:, 1]).all()
        rows = list(map(tuple, pairs.tolist()))
        assert sorted(rows) == rows and not out & set(rows)
        out |= set(rows)
    return out


def test_few_pictures_are_compared_each_with_each() -> None:
    images = images_of([0, 1, 2, 3])
    expected = set(combinations(range(4), 2))
    assert chosen(images, positions([None] * 4)) == expected
    assert chosen(images, positions([None] * 4), exhaustive_limit=4) == expected
    assert chosen(images, positions([None] * 4), exhaustive_limit=3, neighbors=1) < expected
    assert chosen(images[:1], positions([None])) == set()


def test_of_more_pictures_the_nearest_are_compared_first() -> None:
    images, nowhere = images_of(list(range(ALL_AT_ONCE + 1))), positions([None] * (ALL_AT_ONCE + 1))
    every = set(combinations(range(len(images)), 2))
    found = choose_pairs(images, nowhere, PairingConfig(first_neighbors=2), is_video=False)
    assert len(images) - 1 <= len(found.first) <= 2 * len(images)
    assert chosen(images, nowhere, first_neighbors=2) == every
    for options, count in ((PairingConfig(), ALL_AT_ONCE), (PairingConfig(method="exhaustive"), len(images))):
        at_once = choose_pairs(images[:count], nowhere[:count], options, is_video=False)
        assert len(at_once.first) == count * (count - 1) // 2 and not len(at_once.later)


@pytest.mark.parametrize("method", ["sequential", "auto"])
def test_frames_of_a_video_are_compared_with_the_next_ones_and_their_look_alikes(method: str) -> None:
    """Six frames, the last three on the way back: 5 shows what 0 shows, 4 what 1, 3 what 2."""
    images, nowhere = images_of([0, 1, 2, 2, 1, 0]), positions([None] * 6)
    found = chosen(images, nowhere, is_video=True, method=method, overlap=2, neighbors=1)
    following = {(0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (2, 4), (3, 4), (3, 5), (4, 5)}
    assert found == following | {(0, 5), (1, 4)}


def test_an_overlap_beyond_the_last_picture_is_all_pairs() -> None:
    images = images_of([0, 1, 2, 3, 4])
    found = chosen(images, positions([None] * 5), method="sequential", overlap=10**9, neighbors=10**9)
    assert found == set(combinations(range(5), 2))
    assert chosen(images[:1], positions([None]), method="sequential", overlap=10**9) == set()


def test_look_alikes_are_compared() -> None:
    images, nowhere = images_of([0, 1, 2, 1, 0, 2, 2]), positions([None] * 7)
    expected = {(0, 4), (1, 3), (2, 5), (2, 6), (5, 6)}
    assert chosen(images, nowhere, method="retrieval", neighbors=1) <= expected
    two = chosen(images, nowhere, method="retrieval", neighbors=2)
    assert expected <= two
    assert chosen(images, nowhere, exhaustive_limit=6, neighbors=2) == two


def test_the_nearest_neighbors_are_compared_first() -> None:
    """Along a road, each image's nearest neighbor is the next or the last one; the second nearest come later."""
    images, road = images_of(list(range(6))), positions([10.0 * k + 0.1 * k * k for k in range(6)])
    options = PairingConfig(method="spatial", neighbors=2, first_neighbors=1)
    near = choose_pairs(images, road, options, is_video=False)
    similar = choose_pairs(images, road, PairingConfig(method="retrieval", neighbors=5), is_video=False)
    assert {*map(tuple, similar.first.tolist())} == set(combinations(range(6), 2)) and not len(similar.later)
    assert {(k, k + 1) for k in range(5)} <= {*map(tuple, near.first.tolist())}
    retrieved = PairingConfig(method="retrieval", neighbors=2, first_neighbors=1)
    found = choose_pairs(images_of([0, 0, 0, 0, 1, 1]), road, retrieved, is_video=False)
    assert [4, 5] in found.first.tolist() and len(found.later) and [4, 5] not in found.later.tolist()


def test_pictures_taken_near_each_other_are_compared() -> None:
    """Two subjects of six images, taken in turns along a road: 10 m from one to the other, 90 m to the next."""
    images = images_of([0] * 6 + [1] * 6)
    road = positions([100.0 * k for k in range(6)] + [100.0 * k + 10.0 for k in range(6)])
    look_alikes = {*combinations(range(6), 2), *combinations(range(6, 12), 2)}
    near = {(k, k + 6) for k in range(6)}
    assert chosen(images, road, method="spatial", neighbors=1) == look_alikes | near
    assert chosen(images, road, exhaustive_limit=11, neighbors=1) == look_alikes | near
    further = {(k + 1, k + 6) for k in range(5)}  # 90 m onwards
    assert chosen(images, road, method="spatial", neighbors=2) == look_alikes | near | further


@pytest.mark.parametrize("method", ["retrieval", "spatial"])
def test_photographs_taken_one_after_the_other_are_compared_first(method: str) -> None:
    """In the order of time: 3, 1, then 0 and 4 in the same second, by name, and 2 after a pause. Six others have no time."""
    images = images_of([0, 1, 2, 3, 4, 0, 0, 1, 2, 3, 4, 0])
    road = positions([1000.0 * k for k in range(12)])
    options = PairingConfig(method=method, neighbors=2, first_neighbors=1)
    names = ["img_9.jpg", "b.jpg", "c.jpg", "a.jpg", "img_10.jpg", *"defghij"]
    taken_s = np.array([30.0, 20.0, 91.0, 10.0, 30.0, *[np.nan] * 7])
    without = choose_pairs(images, road, options, is_video=False, names=names)
    found = choose_pairs(images, road, options, is_video=False, names=names, taken_s=taken_s)
    following = {(1, 3), (0, 3), (0, 1), (1, 4), (0, 4)}
    first = {*map(tuple, without.first.tolist())}
    assert not following <= first and {*map(tuple, found.first.tolist())} == first | following
    assert not following & {*map(tuple, found.later.tolist())}
    apart = [name if k in (1, 3) else f"other/{name}" for k, name in enumerate(names)]
    two_cameras = choose_pairs(images, road, options, is_video=False, names=apart, taken_s=taken_s)
    assert {*map(tuple, two_cameras.first.tolist())} == first | {(1, 3), (0, 4)}
    never = choose_pairs(images, road, options, is_video=False, names=names, taken_s=np.full(12, np.nan))
    assert never.first.tolist() == without.first.tolist()


def test_a_picture_without_a_place_is_compared_with_its_look_alikes() -> None:
    images = images_of([0] * 6 + [1] * 6)
    road = [100.0 * k for k in range(6)] + [100.0 * k + 10.0 for k in range(6)]
    found = chosen(images, positions([None, *road[1:]]), method="spatial", neighbors=1)
    look_alikes = {*combinations(range(6), 2), *combinations(range(6, 12), 2)}
    # Image 6 has lost its neighbor at 0 m; the next one stands at 100 m.
    assert found == look_alikes | {(k, k + 6) for k in range(1, 6)} | {(1, 6)}


def test_places_are_needed_for_pairs_by_place() -> None:
    images = images_of([0, 1, 2])
    with pytest.raises(ConfigError, match="need GPS"):
        chosen(images, positions([0.0, None, None]), method="spatial")
    # Nine in ten images must have one before they decide by themselves.
    scattered = positions([0.0, 10.0, None])
    by_looks = chosen(images, scattered, method="retrieval", neighbors=1)
    assert chosen(images, scattered, exhaustive_limit=2, neighbors=1) == by_looks


def test_pictures_without_features_are_pairs_of_something_all_the_same() -> None:
    blank = np.zeros((0, 128), np.uint8)
    found = chosen([*images_of([0, 1]), blank], positions([None] * 3), method="retrieval", neighbors=1)
    assert {i for pair in found for i in pair} == {0, 1, 2}


def test_pairs_stand_once_and_in_order() -> None:
    assert sorted_pairs([(3, 1), (1, 3), (2, 2), (0, 3)]).tolist() == [[0, 3], [1, 3]]
    assert sorted_pairs([]).shape == (0, 2)


def test_pairs_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text("# by hand\nb.jpg a.jpg\n\na.jpg b.jpg\nc/d.jpg a.jpg\n")
    assert read_pairs(path, ["a.jpg", "b.jpg", "c/d.jpg"]).tolist() == [[0, 1], [0, 2]]


def test_names_with_spaces_in_a_list_of_pairs(tmp_path: Path) -> None:
    path, names = tmp_path / "pairs.txt", ["a b.jpg", "c.jpg", "c.jpg a b.jpg", "d e.jpg"]
    path.write_text("a b.jpg c.jpg\nd e.jpg\ta b.jpg\n")
    assert read_pairs(path, names).tolist() == [[0, 1], [0, 3]]
    path.write_text("c.jpg a b.jpg c.jpg\n")  # c.jpg + a b.jpg c.jpg is none: the first name is c.jpg a b.jpg
    assert read_pairs(path, names).tolist() == [[1, 2]]


def test_frame_2_comes_before_frame_10() -> None:
    names = tuple(sorted(f"frame_{k}.png" for k in range(1, 13)))
    images = images_of(list(range(12)))
    options = PairingConfig(method="sequential", overlap=1, neighbors=1)
    found = choose_pairs(images, positions([None] * 12), options, is_video=False, names=names).first
    pairs = {(names[i], names[j]) for i, j in found.tolist()} | {
        (names[j], names[i]) for i, j in found.tolist()
    }
    assert {(f"frame_{k}.png", f"frame_{k + 1}.png") for k in range(1, 12)} <= pairs


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a.jpg\n", "line 1: expected two image names, got 1"),
        (b"\na.jpg b.jpg c.jpg\n", "line 2: expected two image names, got 3"),
        (b"a.jpg z.jpg\n", "line 1: image 'z.jpg' does not exist"),
        (b"a.jpg \xff.jpg\n", "cannot be read as a list of pairs"),
    ],
)
def test_a_list_of_pairs_that_is_none_says_where(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "pairs.txt").write_bytes(content)
    with pytest.raises(FileFormatError, match=message):
        read_pairs(tmp_path / "pairs.txt", ["a.jpg", "b.jpg", "c.jpg"])
