"""One run at a time in a folder, and a folder whose run was killed is free."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from epipole.errors import WorkspaceError
from epipole.runs import Job, open_run
from epipole.runs.folder import MARK
from epipole.runs.lock import LOCK, alone_in

HOLD = """
import sys, time
from pathlib import Path
from epipole.io.atomic import atomic_write
from epipole.runs import Job, open_run
root = Path(sys.argv[1])
with open_run(Job(kind="made", inputs=(), settings={}), root) as run:
    with atomic_write(root / "work" / "half.npz") as part, run.folder.publish("model") as aside:
        part.write_text("half")
        (aside / "half.bin").write_text("half")
        print("in", flush=True)
        time.sleep(60)
"""


def test_the_second_is_told_and_the_next_may_enter(tmp_path: Path) -> None:
    root = tmp_path / "out"
    with alone_in(root):
        given = pytest.raises(WorkspaceError, match=r"another run of epipole \(process \d+\) uses .*out")
        with given, alone_in(root):
            pytest.fail("two at once")
        (root / "a.txt").write_text("1")
    with alone_in(root):
        pass
    assert [path.name for path in root.iterdir()] == ["a.txt"]


def test_a_folder_that_was_made_for_nothing_goes(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), alone_in(tmp_path / "out"):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_a_link_in_the_place_of_the_lock_is_not_followed(tmp_path: Path) -> None:
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / LOCK).symlink_to(mine)
    with pytest.raises(WorkspaceError), alone_in(tmp_path / "out"):
        pytest.fail("followed")
    assert mine.read_text() == "mine"


def test_two_processes_and_a_kill(tmp_path: Path) -> None:
    """The second run gets a sentence; after kill -9 the folder is free and nothing half written stays."""
    root, job = tmp_path / "out", Job(kind="made", inputs=(), settings={"b": 2})
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(root)], stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == "in\n"
        with pytest.raises(WorkspaceError, match=f"process {other.pid}"), open_run(job, root):
            pytest.fail("two at once")
        assert len(list(root.rglob(".epipole-*.part*"))) == 2
        other.kill()
        other.wait()
        for _ in range(50):  # until the system has taken the process off its list
            with open_run(job, root) as run:
                run.finish()
            if not (left := list(root.rglob(".epipole-*"))):
                break
            time.sleep(0.1)
    assert left == [] and sorted(p.name for p in root.iterdir()) == ["config.json", MARK, "work"]
