"""What an estimation problem tells the robust loop.

A problem is a named tuple of arrays whose items (matches, points) come in random order, with the methods of
`RobustProblem`: a file for each kind of model writes those that it must, and inherits the rest. They are plain Python
methods; inside kernels Numba compiles the same ones, chosen by the class. The loop (`_loop_kernels`) knows nothing else.
The form is PoseLib's.
"""

from inspect import signature, unwrap
from typing import NamedTuple

import numpy as np
from numba import types
from numba.extending import overload_method

from epipole._jit import overload_options
from epipole._jit.mode import KernelMode, kernel_mode
from epipole.robust._item_kernels import BLOCK, REASSOC, add_normal_equations, columns_within, dot_rows
from epipole.solvers._linear_kernels import clear, clear_rows, copy_numbers

MODEL_SIZE = 32  # space for the largest model
MOST_MODELS = 40  # that one sample can give
MOST_FREEDOM = 9


class Items(NamedTuple):
    """The items of most problems, one a column."""

    items: np.ndarray
    """(rows, n)."""


class RobustProblem:
    """The robust loop's questions; a class of problems derives from this and from its named tuple.

    Whole numbers are returned as np.int64: Numba compiles a function anew for every literal one.
    """

    __slots__ = ()

    # Every problem writes these.

    def sample_size(self):
        """Items in a minimal sample."""

    def degrees_of_freedom(self):
        """Parameters of a step of local optimisation."""

    def workspace(self):
        """Arrays that `solve_sample` and `refine` write into."""

    def solve_sample(self, sample, models, work):
        """Minimal solver: writes models, returns their number."""

    def error_sq(self, model, threshold_sq, k):
        """Squared residual of item k; infinite where the model cannot explain it at all, to within the threshold."""

    def rows_of_block(self, model, threshold_sq, soft_sq, start, stop, rows):
        """Residuals and their derivatives of the items start..stop, one item a column; returns the MSAC score.

        For each number of a residual one row, then one row for each parameter; zero where truncated; multiplied by the
        root of Cauchy's weight 1 / (1 + r^2 / soft_sq), which an infinite soft_sq makes 1.
        """

    def retract(self, model, delta, out):
        """The model moved by a step."""

    def with_items(self, items):
        """The same problem of other items."""

    # Most problems keep these.

    has_unit_steps = False
    """Python only: steps are of one unit, so that one which moves nothing can be told by its size."""

    def breadth(self):
        """Above 1 if a model is only nearly true: thresholds to search at, before looking farther still."""
        return 1.0

    def num_items(self):
        """All items."""
        return self.items.shape[1]

    def residual_size(self):
        """Numbers in one item's residual, one to three."""
        return np.int64(1)

    def refine(self, sample, model, refined, work):
        """Finish a model that passed the test (E gives motions): writes up to four models, returns their number."""
        copy_numbers(model, refined[0])
        return np.int64(1)

    def agreeing(self, model, threshold_sq, start, stop):
        """How many of the items start..stop lie within the threshold of an unsettled model (the sequential test)."""
        count = 0
        for k in range(start, stop):
            count += 1 if self.error_sq(model, threshold_sq, k) < threshold_sq else 0
        return count

    def score_block(self, model, threshold_sq, start, stop):
        """MSAC's sum of min(r^2, threshold^2) over the items start..stop."""
        total = 0.0
        for k in range(start, stop):
            r = self.error_sq(model, threshold_sq, k)
            total += r if r < threshold_sq else threshold_sq
        return total

    def score(self, model, threshold_sq, bail_out):
        """MSAC's sum over all items, lower is better; stops once it exceeds bail_out."""
        total, n = 0.0, self.num_items()
        for start in range(0, n, BLOCK):
            total += self.score_block(model, threshold_sq, start, min(start + BLOCK, n))
            if total > bail_out:
                break
        return total

    def residuals_sq(self, model, threshold_sq, out):
        """Squared residual of every item."""
        for k in range(self.num_items()):
            out[k] = self.error_sq(model, threshold_sq, k)

    def near(self, model, threshold_sq):
        """The problem of the items within the threshold."""
        residuals = np.empty(self.num_items())
        self.residuals_sq(model, threshold_sq, residuals)
        return self.with_items(columns_within(self.items, residuals, threshold_sq))

    def linearize(self, model, threshold_sq, soft_sq, a, b):
        """Gauss-Newton terms J^T W J, J^T W r over the items within the threshold; returns the MSAC score."""
        freedom = self.degrees_of_freedom()
        height = 1 + freedom
        rows = np.empty((self.residual_size() * height, BLOCK))
        clear_rows(a)
        clear(b)
        total, n = 0.0, self.num_items()
        for start in range(0, n, BLOCK):
            stop = min(start + BLOCK, n)
            total += self.rows_of_block(model, threshold_sq, soft_sq, start, stop, rows)
            for first in range(0, len(rows), height):
                for i in range(freedom):
                    b[i] += dot_rows(rows[first + 1 + i], rows[first], stop - start)
                    for j in range(i + 1):
                        a[i, j] += dot_rows(rows[first + 1 + i], rows[first + 1 + j], stop - start)
        self.fix_gauge(model, a)
        for i in range(freedom):
            for j in range(i):
                a[j, i] = a[i, j]
        return total

    def fix_gauge(self, model, a):
        """Fill what a model with more parameters than freedom leaves empty in J^T J (lower triangle)."""

    def escape(self, model, residuals, threshold_sq, state):
        """Leave the best model, in place, where the items that agree with it are degenerate and others ask for another.

        `residuals` are the model's, `state` the random generator's.
        """


class MatrixProblem(RobustProblem):
    """Problems whose residuals are functions of a 3 x 3 matrix that has fewer parameters than entries.

    `rows_of_block` differentiates by the entries (ten rows); the chain rule does the rest.
    """

    __slots__ = ()
    has_unit_steps = True

    def derivatives(self, model, d):
        """Fill d (freedom, 9): the entries of the matrix by the parameters of a step."""

    def linearize(self, model, threshold_sq, soft_sq, a, b):
        """As `RobustProblem.linearize`."""
        freedom = self.degrees_of_freedom()
        d, rows, jac = np.empty((freedom, 9)), np.empty((10, BLOCK)), np.empty((freedom, BLOCK))
        clear_rows(a)
        clear(b)
        self.derivatives(model, d)
        total, n = 0.0, self.num_items()
        for start in range(0, n, BLOCK):
            stop = min(start + BLOCK, n)
            total += self.rows_of_block(model, threshold_sq, soft_sq, start, stop, rows)
            add_normal_equations(d, rows, jac, stop - start, a, b)
        for i in range(freedom):
            for j in range(i):
                a[j, i] = a[i, j]
        return total


_BORROW = {"num_items", "error_sq", "agreeing", "score_block", "score", "residuals_sq", "rows_of_block"}
_FUSED = {"error_sq"}
_SUMS = {"error_sq", "agreeing", "score_block"}


def compile_inside_kernels(declared_by, name):
    """Let kernels call the method `name` of the classes of problems that derive from `declared_by`.

    Numba then takes the name for a method of all named tuples: none that kernels see may have a field of that name.
    """

    def choose(self, *_arguments):
        kind = self.instance_class
        return unwrap(getattr(kind, name)) if issubclass(kind, declared_by) else None

    # Numba compares the parameters with those of what is chosen.
    choose.__signature__ = signature(unwrap(getattr(declared_by, name)))
    options = overload_options(
        allocates=name not in _BORROW,
        fuse=name in _FUSED,
        extra_fastmath=REASSOC if name in _SUMS else frozenset(),
    )
    overload_method(types.BaseNamedTuple, name, jit_options=options)(choose)


if kernel_mode() is not KernelMode.PYTHON:
    for _name in [name for name, value in vars(RobustProblem).items() if name[0] != "_" and callable(value)]:
        compile_inside_kernels(RobustProblem, _name)
    compile_inside_kernels(MatrixProblem, "derivatives")
