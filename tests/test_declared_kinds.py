"""Kinds of annotations that are kept at the border: paths, named tuples, mappings, and any number of arguments."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from jaxtyping import Float64

from epipole._checks import checked
from epipole.errors import ConfigError, ShapeError


class Held(NamedTuple):
    values: Float64[np.ndarray, " n"]
    name: str


@checked
def take(*paths: str | Path, size: int = 1) -> Any:
    return paths, size


@checked
def use(fixed: Held, table: Mapping[str, Float64[np.ndarray, " 2"]]) -> Any:
    return fixed, table


@pytest.mark.parametrize("path", [3, None, b"a", "", "\0", "a" * 256, "a/" * 3000, ["a"], "\ud800"])
def test_what_is_no_path_is_refused_wherever_it_stands(path):
    assert take("a", Path("b"), size=2) == (("a", Path("b")), 2)
    with pytest.raises(ConfigError, match=r"paths\[1\]"):
        take("a", path)
    with pytest.raises(ConfigError, match="size"):
        take("a", "b", "c", size="large")


def test_named_tuples_and_mappings_are_looked_into():
    given = Held(np.ones(3), "a"), {"b": np.ones(2)}
    assert use(*given)[0] is given[0] and use(*given)[1] is given[1]
    assert use(Held([1, 2], "a"), {"b": [1, 2]})[1]["b"].dtype == np.float64
    for fixed in (Held(np.ones((2, 2)), "a"), Held(np.ones(2), 5), Held(None, "a"), (np.ones(2), "a")):
        with pytest.raises((ShapeError, ConfigError), match="fixed"):
            use(fixed, {})
    for table in ({"b": np.ones(3)}, {5: np.ones(2)}, [("b", np.ones(2))]):
        with pytest.raises((ShapeError, ConfigError), match="table"):
            use(given[0], table)
