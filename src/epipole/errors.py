"""The exceptions that epipole raises deliberately.

Misuse and bad files raise. A failed *estimation* does not: estimators return a result with a reason.
"""

from pathlib import Path

_LONGEST_PROBLEM = 2000


class EpipoleError(Exception):
    """Base of all errors raised deliberately; the command line prints them as one line."""


class ShapeError(EpipoleError, ValueError):
    """An array has the wrong shape, type or contents (such as NaN where numbers are needed)."""


class ConfigError(EpipoleError, ValueError):
    """An option has an unusable value."""


class ArgumentError(EpipoleError, TypeError):
    """A function has no argument of this name; also a `TypeError`, as raised by Python."""


class DegenerateGeometryError(EpipoleError, ValueError):
    """The geometry is degenerate (no baseline, collinear points, fewer points than unknowns)."""


class FileFormatError(EpipoleError, ValueError):
    """A file is missing, damaged or in another format; the message names the file and the location."""

    def __init__(self, path: Path | str, problem: str) -> None:
        # Quotes from the file may be endless, or unsuitable for a terminal's encoding.
        if len(problem) > _LONGEST_PROBLEM:
            problem = f"{problem[:_LONGEST_PROBLEM]} ..."
        problem = problem.encode(errors="backslashreplace").decode()
        super().__init__(f"{path}: {problem}")
        self.path = Path(path)
        self._problem = problem

    def __reduce__(self) -> tuple[type["FileFormatError"], tuple[Path, str]]:
        """Both arguments, so that the error can be pickled between processes."""
        return type(self), (self.path, self._problem)


class WorkspaceError(EpipoleError, OSError):
    """The output folder cannot be used (not writable, full, or in use for something else)."""


class NoModelError(EpipoleError, RuntimeError):
    """The images give no 3D model; the message gives the reason."""


class MissingDependencyError(EpipoleError, ImportError):
    """An optional package is not installed; the message names it."""
