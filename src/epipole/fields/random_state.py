"""State of a random generator as an array, so that a resumed training gives the same bits."""

from __future__ import annotations

import json

import numpy as np

from epipole._checks.tables import TEXT, Expected
from epipole.errors import ShapeError

STATE = Expected(TEXT)
"""Array returned by `state_of`."""


def state_of(rng: np.random.Generator) -> np.ndarray:
    """State of a generator, as text in an array."""
    return np.array(json.dumps(rng.bit_generator.state))


def set_state(rng: np.random.Generator, state: np.ndarray) -> None:
    """Set the state of a generator to one returned by `state_of`.

    Raises:
        ShapeError: it is not a generator state.
    """
    try:
        rng.bit_generator.state = json.loads(str(state))
    except (ValueError, TypeError, LookupError, OverflowError, AttributeError, RecursionError) as error:
        raise ShapeError(f"the random generator's state is invalid: {error!r:.100}") from error
