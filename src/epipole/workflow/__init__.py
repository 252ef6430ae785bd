"""Units of work, the executor behind them, resume and progress."""

from epipole.workflow.progress import Progress as Progress
from epipole.workflow.progress import ProgressCallback as ProgressCallback
from epipole.workflow.progress import ignore_progress as ignore_progress
from epipole.workflow.progress import timed as timed
from epipole.workflow.units import Unit as Unit
from epipole.workflow.units import digest as digest
from epipole.workflow.units import load as load
from epipole.workflow.units import run_units as run_units
from epipole.workflow.units import store as store
from epipole.workflow.units import stored_key as stored_key
