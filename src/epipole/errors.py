"""The exceptions that epipole raises on purpose.

Misuse and bad files raise. A failure to *estimate* is data: estimators return a result with a reason.
"""

from pathlib import Path

_LONGEST_PROBLEM = 2000


class EpipoleError(Exception):
    """Base of every error raised on purpose; the command line prints it as one line."""


class ShapeError(EpipoleError, ValueError):
    """An array has the wrong shape, type or contents (NaN where numbers are needed)."""


class ConfigError(EpipoleError, ValueError):
    """An option has a value that cannot be used."""


class ArgumentError(EpipoleError, TypeError):
    """A function has no argument of this name; also a `TypeError`, which Python raises for it."""


class DegenerateGeometryError(EpipoleError, ValueError):
    """The geometry is degenerate (no baseline, collinear points, fewer points than unknowns)."""


class FileFormatError(EpipoleError, ValueError):
    """A file is missing, damaged or of another format; the message names the file and the place."""

    def __init__(self, path: Path | str, problem: str) -> None:
        # What is quoted comes from the file: it may be endless, or unfit for a terminal's encoding.
        if len(problem) > _LONGEST_PROBLEM:
            problem = f"{problem[:_LONGEST_PROBLEM]} ..."
        problem = problem.encode(errors="backslashreplace").decode()
        super().__init__(f"{path}: {problem}")
        self.path = Path(path)
        self._problem = problem

    def __reduce__(self) -> tuple[type["FileFormatError"], tuple[Path, str]]:
        """Both arguments, so that the error comes whole out of another process."""
        return type(self), (self.path, self._problem)


class WorkspaceError(EpipoleError, OSError):
    """The output folder cannot be used (not writable, full, or it holds something else)."""


class NoModelError(EpipoleError, RuntimeError):
    """The images give no 3D model; the message says why."""


class MissingDependencyError(EpipoleError, ImportError):
    """An optional package is not installed; the message names what to install."""
