"""What an estimation problem tells the robust loop.

A problem is a NamedTuple of arrays whose items (matches, points) come in random order; its type selects, at
compile time, the functions below. A file for each problem holds their implementations; the loop
(`_loop_kernels`) knows nothing else. The form is PoseLib's.
"""

from inspect import signature, unwrap

from numba import types
from numba.extending import overload

from epipole._jit import OVERLOAD_OPTIONS

MODEL_SIZE = 32  # room for the largest model
MOST_MODELS = 40  # that one sample can give
MOST_FREEDOM = 9


def sample_size(problem):
    """Items in a minimal sample."""


def num_items(problem):
    """All items."""


def degrees_of_freedom(problem):
    """Parameters of a step of local optimisation."""


def workspace(problem):
    """Arrays that `solve_sample` writes into."""


def solve_sample(problem, sample, models, work):
    """Minimal solver: writes models, returns their number."""


def agreeing(problem, model, threshold_sq, start, stop):
    """How many of the items start..stop lie within the threshold of an unsettled model (the sequential test)."""


def settle(problem, sample, model, settled, work):
    """Finish a model that passed the test (E gives motions): writes up to four models, returns their number."""


def score(problem, model, threshold_sq, bail_out):
    """MSAC's sum of min(r^2, threshold^2), lower is better; may stop once it exceeds bail_out."""


def residuals_sq(problem, model, threshold_sq, out):
    """Squared residual of every item; infinite where the model cannot explain it at all, to within the threshold."""


def near(problem, model, threshold_sq):
    """The problem of the items within the threshold."""


def residual_size(problem):
    """Numbers in one item's residual, one to three."""


def linearize(problem, model, threshold_sq, soft_sq, a, b):
    """Gauss-Newton terms J^T W J, J^T W r over the items within the threshold; returns the MSAC score.

    W = 1 / (1 + r^2 / soft_sq), Cauchy's weights; infinite soft_sq gives plain least squares.
    """


def retract(problem, model, delta, out):
    """The model moved by a step."""


def escape(problem, model, residuals, threshold_sq, state):
    """Leave the best model, in place, where the items that agree with it are degenerate and others ask for another.

    Optional. `residuals` are the model's, `state` the random generator's.
    """


def _stay(problem, model, residuals, threshold_sq, state):
    pass


def implement(problem_type, **implementations):
    """Register the functions of a problem type; at compile time the type of `problem` selects them."""
    for name, function in implementations.items():
        # A type-checking wrapper of the test run is no function that Numba could read.
        _implementations[name][problem_type.__name__] = unwrap(function)


_implementations: dict[str, dict] = {}
_otherwise = {"escape": unwrap(_stay)}


def _open(function):
    known = _implementations.setdefault(function.__name__, {})

    def choose(problem):
        if isinstance(problem, types.BaseNamedTuple):
            return known.get(problem.instance_class.__name__, _otherwise.get(function.__name__))
        return None

    # Numba wants the chooser's parameters to be named as the function's.
    names = ", ".join(signature(function).parameters)
    scope = {"choose": choose}
    exec(f"def chooser({names}): return choose(problem)", scope)
    overload(function, jit_options=OVERLOAD_OPTIONS)(scope["chooser"])


for _function in (
    *(sample_size, num_items, degrees_of_freedom, workspace, solve_sample, agreeing, settle),
    *(score, residuals_sq, near, residual_size, linearize, retract, escape),
):
    _open(_function)
