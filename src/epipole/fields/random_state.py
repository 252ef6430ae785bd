"""A random generator's state as an array, so that a training can go on with the same bits."""

from __future__ import annotations

import json

import numpy as np

from epipole._declared.tables import TEXT, Expected
from epipole.errors import ShapeError

STATE = Expected(TEXT)
"""What `state_of` makes."""


def state_of(rng: np.random.Generator) -> np.ndarray:
    """The state, as text in an array."""
    return np.array(json.dumps(rng.bit_generator.state))


def set_state(rng: np.random.Generator, state: np.ndarray) -> None:
    """Go on from a `state_of`.

    Raises:
        ShapeError: it is none.
    """
    try:
        rng.bit_generator.state = json.loads(str(state))
    except (ValueError, TypeError, LookupError, OverflowError, AttributeError, RecursionError) as error:
        raise ShapeError(f"the state of the random numbers cannot be used: {error!r:.100}") from error
