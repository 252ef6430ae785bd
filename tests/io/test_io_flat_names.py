"""Images get files of their own in one folder, whatever their names are."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from epipole.io.names import flat_names

PARTS = st.text(st.sampled_from("aAbB._-/2 "), min_size=1, max_size=6)


@pytest.mark.parametrize(
    ("names", "flat"),
    [
        (["a.png", "b/c.png", "d.tar.gz"], ["a", "b_c", "d.tar"]),
        (["a.png", "a.jpg"], ["a.png", "a.jpg"]),
        (["b/c.png", "b_c.png", "b/c.jpg"], ["b_c.png", "b_c.png_2", "b_c.jpg"]),
        (["A.png", "a.png", "x.png"], ["A.png", "a.png_2", "x"]),
        (["a.png", "a.jpg", "a.png.tif"], ["a.png_2", "a.jpg", "a.png"]),
        (["frame.0001", "frame.0002"], ["frame.0001", "frame.0002"]),
        ([], []),
    ],
)
def test_known_names(names: list[str], flat: list[str]) -> None:
    assert flat_names(names) == flat


@given(st.lists(PARTS, unique=True, max_size=12))
def test_no_two_are_the_same_and_none_is_a_folder(names: list[str]) -> None:
    names = [name for name in names if name.strip("/. ")]
    found = flat_names(names)
    assert len({each.casefold() for each in found}) == len(names)
    assert not any("/" in each for each in found)
