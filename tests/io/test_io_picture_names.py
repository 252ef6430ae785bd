"""Patterns on names, and which 16-bit grey images are depth."""

import pytest

from epipole.io.images.image_names import depth_among, fits


@pytest.mark.parametrize(
    ("name", "pattern", "expected"),
    [
        ("a/frame.color.jpg", "*.color.jpg", True),
        ("a/frame.depth.png", "*.color.jpg", False),
        ("a/frame.jpg", "frame*", True),
        ("a/frame.jpg", "a/*", True),
        ("b/frame.jpg", "a/*", False),
        ("A.JPG", "*.jpg", False),
        ("A.JPG", "*.[jJ][pP][gG]", True),
    ],
)
def test_patterns_fit_the_relative_name_or_the_files_own(name, pattern, expected):
    assert fits(name, pattern) is expected


RGBD = {
    "7-Scenes": (["frame-000000.color.png", "frame-000001.color.png"], ["frame-000000.depth.png"]),
    "TUM": (["rgb/1305031102.17.png", "rgb/1305031102.21.png"], ["depth/1305031102.16.png"] * 1),
    "same numbers": (["image/1.png", "image/2.png"], ["raw/1.png", "raw/2.png"]),
}


@pytest.mark.parametrize("kind", RGBD)
def test_depth_beside_colour_is_found(kind):
    colour, depth = RGBD[kind]
    assert depth_among([*depth, *colour], frozenset(depth)) == depth


@pytest.mark.parametrize(
    ("others", "deep"),
    [
        ([], ["depth_1.png", "depth_2.png"]),  # nothing else is there
        (["IMG_1.jpg", "IMG_2.jpg"], ["DSC_0107.png", "DSC_0108.png"]),  # a camera of 16 bits beside a phone
        (["1.jpg", "2.jpg", "3.jpg", "4.jpg", "5.jpg"], ["a1.png"]),  # one of many
        (["1.jpg", "2.jpg"], ["a1.png", "a7.png"]),  # not each has its colour image
    ],
)
def test_sixteen_bits_alone_are_no_depth(others, deep):
    assert depth_among([*others, *deep], frozenset(deep)) == []
