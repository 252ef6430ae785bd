"""The checks of types in the test run: wrong ones are refused in the first calls of a test, and in some later ones."""

import jaxtyping
import numpy as np
import pytest
from beartype import beartype

import epipole.geometry.homogeneous as homogeneous
from type_checks import EVERY, FIRST, sampled, switched_off


def doubled(values: jaxtyping.Float64[np.ndarray, "n 3"]) -> jaxtyping.Float64[np.ndarray, "n 3"]:
    return 2 * values


def test_wrong_shapes_are_refused_in_first_and_some_later_calls() -> None:
    call, wrong = sampled(doubled, typechecker=beartype), np.zeros((2, 4))
    refused = 0
    for _ in range(FIRST + 4 * EVERY):
        try:
            call(wrong)
        except jaxtyping.TypeCheckError:
            refused += 1
    assert refused == FIRST + 4
    with switched_off():
        call(wrong)
    with pytest.raises(jaxtyping.TypeCheckError):
        call(wrong)


def test_the_package_is_checked() -> None:
    functions = [
        f for f in vars(homogeneous).values() if getattr(f, "__module__", "") == homogeneous.__name__
    ]
    assert functions and any(hasattr(f, "is_sampled") or hasattr(f, "__wrapped__") for f in functions)
