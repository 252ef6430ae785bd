"""The interface between an estimation problem and the robust loop.

A problem is a named tuple of arrays whose items (matches, points) come in random order, with the methods of
`RobustProblem`: there is a file per kind of model, which implements the required methods and inherits the rest. They are
plain Python methods; inside kernels Numba compiles the same ones, chosen by the class. The loop (`_loop_kernels`) depends
on nothing else. The design is PoseLib's.
"""

from inspect import signature, unwrap
from typing import NamedTuple

import numpy as np
from numba import types
from numba.extending import overload_method

from epipole._jit import overload_options
from epipole._jit.mode import KernelMode, kernel_mode
from epipole.robust._item_kernels import (
    BLOCK,
    REASSOC,
    add_normal_equations,
    columns_within,
    dot_rows,
    sum_row,
)
from epipole.solvers._linear_kernels import clear, clear_rows, copy_numbers

MODEL_SIZE = 32  # size of the largest model
MOST_MODELS = 40  # per sample
MOST_FREEDOM = 9


class Items(NamedTuple):
    """The items of most problems, one per column."""

    items: np.ndarray
    """(rows, n)."""


class RobustProblem:
    """Interface of the robust loop; a problem class derives from this and from its named tuple.

    Integers are returned as np.int64: Numba compiles a function again for every literal one.
    """

    __slots__ = ()

    # Required.

    def sample_size(self):
        """Number of items in a minimal sample."""

    def degrees_of_freedom(self):
        """Number of parameters of a step of local optimization."""

    def workspace(self):
        """Working arrays of `solve_sample` and `refine`."""

    def solve_sample(self, sample, models, work):
        """Minimal solver: writes models, returns their number."""

    def error_sq(self, model, threshold_sq, k):
        """Squared residual of item k; infinite if the model cannot explain it (within the threshold)."""

    def rows_of_block(self, model, threshold_sq, soft_sq, start, stop, rows):
        """Residuals and their derivatives for items start..stop, one item per column.

        Per number of a residual there is one row, then one row per parameter; zero where truncated, and multiplied by the square
        root of the Cauchy weight 1 / (1 + r^2 / soft_sq), which is 1 for an infinite soft_sq. The last row has min(r^2,
        threshold^2), whose sum is the MSAC score: this loop writes, so it must not sum (see `REASSOC`).
        """

    def retract(self, model, delta, out):
        """Apply a step to the model."""

    def with_items(self, items):
        """The same problem with other items."""

    # Optional.

    has_unit_steps = False
    """Python only: step parameters have one unit, so a step without effect can be recognized by its size."""

    def breadth(self):
        """Factor above 1 for approximate models: search at this multiple of the threshold, and polish beyond it."""
        return 1.0

    def num_items(self):
        """Number of items."""
        return self.items.shape[1]

    def residual_size(self):
        """Dimension of the residual of one item, one to three."""
        return np.int64(1)

    def refine(self, sample, model, refined, work):
        """Finish a model that passed the test (E gives motions): writes up to four models, returns their number."""
        copy_numbers(model, refined[0])
        return np.int64(1)

    def agreeing(self, model, threshold_sq, start, stop):
        """Number of items start..stop within the threshold of an unfinished model (for the sequential test)."""
        count = 0
        for k in range(start, stop):
            count += 1 if self.error_sq(model, threshold_sq, k) < threshold_sq else 0
        return count

    def score_block(self, model, threshold_sq, start, stop):
        """MSAC score of items start..stop: the sum of min(r^2, threshold^2)."""
        total = 0.0
        for k in range(start, stop):
            r = self.error_sq(model, threshold_sq, k)
            total += r if r < threshold_sq else threshold_sq
        return total

    def score(self, model, threshold_sq, bail_out):
        """MSAC score of all items, lower is better; stops once it exceeds bail_out."""
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
        """The problem restricted to items within the threshold."""
        residuals = np.empty(self.num_items())
        self.residuals_sq(model, threshold_sq, residuals)
        return self.with_items(columns_within(self.items, residuals, threshold_sq))

    def linearize(self, model, threshold_sq, soft_sq, a, b):
        """Gauss-Newton terms J^T W J, J^T W r over items within the threshold; returns the MSAC score."""
        freedom = self.degrees_of_freedom()
        height = 1 + freedom
        last = self.residual_size() * height
        rows = np.empty((last + 1, BLOCK))
        clear_rows(a)
        clear(b)
        total, n = 0.0, self.num_items()
        for start in range(0, n, BLOCK):
            stop = min(start + BLOCK, n)
            self.rows_of_block(model, threshold_sq, soft_sq, start, stop, rows)
            total += sum_row(rows[last], stop - start)
            for first in range(0, last, height):
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
        """Make J^T J (lower triangle) regular for a model with more parameters than degrees of freedom."""

    def escape(self, model, residuals, threshold_sq, state):
        """Replace the best model, in place, if its inliers are degenerate and the other items support another one.

        `residuals` are the model's, `state` is that of the random generator.
        """


class MatrixProblem(RobustProblem):
    """Problems whose residuals depend on a 3 x 3 matrix with fewer degrees of freedom than entries.

    `rows_of_block` differentiates by the entries (ten rows and the score's); the chain rule does the rest.
    """

    __slots__ = ()
    has_unit_steps = True

    def derivatives(self, model, d):
        """Fill d (freedom, 9): derivatives of the matrix entries by the step parameters."""

    def linearize(self, model, threshold_sq, soft_sq, a, b):
        """As `RobustProblem.linearize`."""
        freedom = self.degrees_of_freedom()
        d, rows, jac = np.empty((freedom, 9)), np.empty((11, BLOCK)), np.empty((freedom, BLOCK))
        clear_rows(a)
        clear(b)
        self.derivatives(model, d)
        total, n = 0.0, self.num_items()
        for start in range(0, n, BLOCK):
            stop = min(start + BLOCK, n)
            self.rows_of_block(model, threshold_sq, soft_sq, start, stop, rows)
            total += sum_row(rows[10], stop - start)
            add_normal_equations(d, rows, jac, stop - start, a, b)
        for i in range(freedom):
            for j in range(i):
                a[j, i] = a[i, j]
        return total


_BORROW = {"num_items", "error_sq", "agreeing", "score_block", "score", "residuals_sq", "rows_of_block"}
_FUSED = {"error_sq"}
_SUMS = {"agreeing", "score_block"}


def compile_inside_kernels(declared_by, name):
    """Make the method `name` of problem classes derived from `declared_by` callable inside kernels.

    Numba then treats the name as a method of all named tuples: no named tuple used in kernels may have a field of that name.
    """

    def choose(self, *_arguments):
        kind = self.instance_class
        return unwrap(getattr(kind, name)) if issubclass(kind, declared_by) else None

    # Numba compares the parameters with those of the chosen method.
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
