"""A run with fewer frames does not replace a better result unnoticed."""

import pytest
from slam_rides import write_pairs

from epipole.errors import WorkspaceError
from epipole.pipelines.slam import run
from epipole.pipelines.slam.run import slam as run_slam
from epipole.runs import overwriting


def contents(out):
    """Files of the result; the log, too, tells of the refused runs."""
    runs = {"epipole.json", "log.txt"}
    return {path.name: path.read_bytes() for path in out.glob("*.*") if path.name not in runs}


@pytest.mark.usefixtures("unchecked")
def test_fewer_frames_keep_the_earlier_result(tmp_path, monkeypatch):
    folder, out = write_pairs(tmp_path / "ride", 12), tmp_path / "out"
    assert run_slam(folder, out).summary["num_localized"] == 12
    before, log = contents(out), (out / "log.txt").read_text()
    with monkeypatch.context() as patched:
        patched.setattr(run, "find_camera", lambda *_: pytest.fail("no work is done"))
        with pytest.raises(WorkspaceError, match=r"12 localized frames, more than the 5 .*--overwrite"):
            run_slam(folder, out, max_frames=5)
    with pytest.raises(WorkspaceError, match="12 localized frames, more than the 6 of this run"):
        run_slam(folder, out, stride=2)
    assert contents(out) == before
    assert (out / "log.txt").read_text().startswith(log)
    assert run_slam(folder, out).summary["num_localized"] == 12  # as many are fine
    with overwriting():
        assert run_slam(folder, out, stride=2).summary["num_localized"] == 6
    assert run_slam(folder, out, max_frames=8).summary["num_localized"] == 8
