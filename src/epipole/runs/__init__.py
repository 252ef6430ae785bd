"""The run layer, common to all jobs that write an output folder."""

from epipole.runs.contents import content_digests as content_digests
from epipole.runs.executors import ExecutorChoice as ExecutorChoice
from epipole.runs.folder import OutputFolder as OutputFolder
from epipole.runs.folder import claim as claim
from epipole.runs.folder import has_own_model as has_own_model
from epipole.runs.folder import read_mark as read_mark
from epipole.runs.guard import is_overwriting as is_overwriting
from epipole.runs.guard import overwriting as overwriting
from epipole.runs.guard import refuse_existing as refuse_existing
from epipole.runs.guard import replacing_file as replacing_file
from epipole.runs.interrupts import graceful_interrupt as graceful_interrupt
from epipole.runs.progress import Progress as Progress
from epipole.runs.progress import ProgressCallback as ProgressCallback
from epipole.runs.progress import ignore_progress as ignore_progress
from epipole.runs.run import Job as Job
from epipole.runs.run import Run as Run
from epipole.runs.run import is_finished as is_finished
from epipole.runs.run import open_run as open_run
from epipole.runs.threads import thread_scope as thread_scope
from epipole.runs.units import Unit as Unit
from epipole.runs.units import digest as digest
from epipole.runs.units import is_done as is_done
from epipole.runs.units import load as load
from epipole.runs.units import run_units as run_units
from epipole.runs.units import store as store
from epipole.runs.units import stored_key as stored_key
