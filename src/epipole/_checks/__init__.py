"""The one validator at the public border: what annotations declare (`declared`), and checks of single arguments (`arguments`).

`arguments` needs NumPy and is imported on first use: the command line's help does without.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from epipole._checks.declared import Declared as Declared
from epipole._checks.declared import check_fields as check_fields
from epipole._checks.declared import check_least as check_least
from epipole._checks.declared import check_options as check_options
from epipole._checks.declared import checked as checked
from epipole._checks.declared import did_you_mean as did_you_mean

if TYPE_CHECKING:
    from epipole._checks.arguments import MOST_PIXELS as MOST_PIXELS
    from epipole._checks.arguments import MOST_RENDERED_PIXELS as MOST_RENDERED_PIXELS
    from epipole._checks.arguments import as_directions as as_directions
    from epipole._checks.arguments import as_float_array as as_float_array
    from epipole._checks.arguments import as_image as as_image
    from epipole._checks.arguments import as_path as as_path
    from epipole._checks.arguments import as_points as as_points
    from epipole._checks.arguments import as_table as as_table
    from epipole._checks.arguments import as_vector as as_vector
    from epipole._checks.arguments import check_broadcast as check_broadcast
    from epipole._checks.arguments import check_count as check_count
    from epipole._checks.arguments import check_different as check_different
    from epipole._checks.arguments import check_fraction as check_fraction
    from epipole._checks.arguments import check_index as check_index
    from epipole._checks.arguments import check_indices as check_indices
    from epipole._checks.arguments import check_offsets as check_offsets
    from epipole._checks.arguments import check_pixels as check_pixels
    from epipole._checks.arguments import check_seed as check_seed
    from epipole._checks.arguments import check_squarable as check_squarable
    from epipole._checks.arguments import require_same_length as require_same_length


def __getattr__(name: str) -> Any:
    return getattr(import_module("epipole._checks.arguments"), name)
