"""Pairs measured by other threads, or by a cluster: the files, problems and continued runs are those of one pair after the other."""

from pathlib import Path

import pytest
from PIL import Image

from epipole.cli.main import main
from epipole.pipelines.stereo import pair_units, run
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.run import stereo_many
from epipole.scene import RectifiedRig
from epipole.synthetic.stereo_rooms import stereo_room
from whole import in_whole_run

pytestmark = pytest.mark.usefixtures("two_threads")

CONFIG = StereoConfig(max_disparity_px=40)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`left` and `right` with three pairs, the second of which is damaged."""
    folder = tmp_path_factory.mktemp("pairs")
    for n, name in enumerate(("a", "b", "sub/c")):
        pair = stereo_room(n, (120, 90))
        for side, image in (("left", pair.left), ("right", pair.right)):
            path = folder / side / f"{name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(image).save(path)
    damaged = folder / "right" / "b.png"
    damaged.write_bytes(damaged.read_bytes()[:500])
    return folder


RIG = RectifiedRig(100.0, 60.0, 45.0, 0.1)
RIG_OPTIONS = ["--focal-px", "100", "--baseline", "0.1", "--principal-point", "60", "45"]


def contents(out: Path) -> dict[str, bytes]:
    """All files but hidden ones, such as locks."""
    paths = [path for path in out.rglob("*") if path.is_file() and path.name[0] != "."]
    return {str(path.relative_to(out)): path.read_bytes() for path in paths}


@pytest.fixture(scope="module")
def whole(folders: Path) -> dict[str, bytes]:
    batch = stereo_many(folders / "left", folders / "right", folders / "whole", CONFIG, RIG)
    assert batch.done == ("a", "sub/c") and list(batch.problems) == ["b"]
    found = contents(folders / "whole")
    assert {"a/depth.pfm", "a/report.html", "sub/c/summary.json", "summary.json"} <= found.keys()
    return found


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pairs are measured by threads instead of a cluster."""
    monkeypatch.setattr(run, "chosen_executor", lambda *_, **__: "threads")


@pytest.mark.usefixtures("threads")
def test_threads_write_the_same_files(folders: Path, whole: dict[str, bytes]) -> None:
    seen = []
    out = folders / "threads"
    batch = stereo_many(folders / "left", folders / "right", out, CONFIG, RIG, seen.append)
    assert batch.done == ("a", "sub/c") and str(folders / "right" / "b.png") in batch.problems["b"]
    assert contents(out) == whole and not (out / "units").exists()
    assert [(one.done, one.total) for one in seen if one.stage == "pairs"] == [(0, 3), (1, 3), (2, 3), (3, 3)]
    again = stereo_many(folders / "left", folders / "right", out, CONFIG, RIG)
    assert again.earlier == ("a", "sub/c") and not again.done


@pytest.mark.usefixtures("threads")
def test_an_interrupted_run_continues(
    folders: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, real, count = folders / "interrupted", pair_units.measured, [0]

    def interrupted(*given: object) -> object:
        count[0] += 1
        if count[0] == 2:
            raise KeyboardInterrupt
        return real(*given)

    monkeypatch.setattr(pair_units, "measured", interrupted)
    with pytest.raises(KeyboardInterrupt), monkeypatch.context() as context:
        context.setattr(run, "_measure_into", None)  # nothing is written before all pairs are measured
        stereo_many(folders / "left", folders / "right", out, CONFIG, RIG)
    num_left = len(list((out / "units").glob("*.npz")))
    assert num_left in (1, 2)  # two threads: the other one finishes its pair
    monkeypatch.setattr(pair_units, "measured", real)
    stereo_many(folders / "left", folders / "right", out, CONFIG, RIG)
    assert contents(out) == whole


@in_whole_run
def test_a_cluster_writes_the_same_files(
    folders: Path, whole: dict[str, bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("distributed")
    out = folders / "cluster"
    given = ["stereo", str(folders / "left"), str(folders / "right"), str(out), "--max-disparity-px", "40"]
    main([*given, *RIG_OPTIONS, "--cluster", "local:2", "--no-shared-folder"])
    assert contents(out) == whole
    printed = capsys.readouterr()
    assert str(folders / "right" / "b.png") in " ".join(printed.out.split())
    assert "Threads of the cluster: 2; dashboard: http://127.0.0.1" in printed.err


def test_a_cluster_is_for_many_pairs(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    left, right = (str(folders / side / "a.png") for side in ("left", "right"))
    with pytest.raises(SystemExit):
        main(["stereo", left, right, str(folders / "one"), "--cluster", "local:2"])
    assert "two folders" in capsys.readouterr().err
