"""A random generator's state as an array, so that a training can go on with the same bits."""

from __future__ import annotations

import json

import numpy as np


def state_of(rng: np.random.Generator) -> np.ndarray:
    """The state, as text in an array."""
    return np.array(json.dumps(rng.bit_generator.state))


def set_state(rng: np.random.Generator, state: np.ndarray) -> None:
    """Go on from a `state_of`."""
    rng.bit_generator.state = json.loads(str(state))
