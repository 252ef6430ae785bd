"""Output folders: whose they are, what is published, and that nothing of the user's is lost."""

import json
from pathlib import Path

import pytest

from epipole.errors import WorkspaceError
from epipole.runs.folder import MARK, OutputFolder, claim, read_mark


def names(root: Path) -> list[str]:
    return sorted(p.relative_to(root).as_posix() for p in root.rglob("*") if p.is_file() and p.name != MARK)


@pytest.fixture
def folder(tmp_path: Path) -> OutputFolder:
    return claim(tmp_path / "out", "made", "/pictures")


def publish(folder: OutputFolder, group: str, files: dict[str, str]) -> None:
    with folder.publish(group) as aside:
        for name, text in files.items():
            (aside / name).parent.mkdir(parents=True, exist_ok=True)
            (aside / name).write_text(text)


def test_a_new_folder_is_marked_with_kind_source_and_version(folder: OutputFolder) -> None:
    mark = json.loads((folder.root / MARK).read_text())
    assert (mark["kind"], mark["source"], mark["files"]) == ("made", "/pictures", {})
    assert mark["version"] and mark["format"] == 2


def test_the_same_run_comes_back_and_others_do_not(folder: OutputFolder) -> None:
    publish(folder, "model", {"a.bin": "1"})
    again = claim(folder.root, "made", "/pictures")
    assert again.files == {"model": ["a.bin"]}
    for kind, source in (("other", "/pictures"), ("made", "/elsewhere")):
        with pytest.raises(WorkspaceError, match="holds the results of `epipole made` of /pictures"):
            claim(folder.root, kind, source)


def test_a_marked_folder_without_results_may_be_taken(folder: OutputFolder) -> None:
    taken = claim(folder.root, "other", "/elsewhere")
    assert (taken.kind, taken.source) == ("other", "/elsewhere")


def test_folders_of_others_are_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(WorkspaceError, match="not made by epipole"):
        claim(tmp_path, "made", "/pictures")
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(WorkspaceError, match="is a file"):
        claim(tmp_path / "notes.txt", "made", "/pictures")


def test_results_do_not_go_among_the_inputs(tmp_path: Path) -> None:
    picture = tmp_path / "left.png"
    picture.write_bytes(b"")
    for given in (picture, tmp_path):
        with pytest.raises(WorkspaceError, match="choose another for the results"):
            claim(tmp_path, "made", "x", [given])
    claim(tmp_path / "out", "made", "x", [picture, tmp_path])


def test_results_appear_together_and_stale_ones_go(folder: OutputFolder) -> None:
    publish(folder, "model", {"sparse/0/a.bin": "1", "sparse/1/b.bin": "2", "c.txt": "3"})
    publish(folder, "report", {"report.html": "4"})
    publish(folder, "model", {"sparse/0/a.bin": "5"})
    assert names(folder.root) == ["report.html", "sparse/0/a.bin"]
    assert (folder.root / "sparse/0/a.bin").read_text() == "5"
    assert not (folder.root / "sparse/1").exists()  # nor an empty folder of it
    assert claim(folder.root, "made", "/pictures").files == folder.files


def test_a_block_that_fails_changes_nothing(folder: OutputFolder) -> None:
    publish(folder, "model", {"a.bin": "1"})
    with pytest.raises(ZeroDivisionError), folder.publish("model") as aside:
        (aside / "a.bin").write_text("2")
        raise ZeroDivisionError
    assert names(folder.root) == ["a.bin"] and (folder.root / "a.bin").read_text() == "1"


def test_a_file_that_no_run_has_written_is_kept(folder: OutputFolder) -> None:
    publish(folder, "model", {"a.bin": "1"})
    (folder.root / "b.bin").write_text("mine")
    with pytest.raises(WorkspaceError, match=r"holds b\.bin, which no earlier run has written"):
        publish(folder, "model", {"a.bin": "2", "b.bin": "2"})
    assert (folder.root / "b.bin").read_text() == "mine" and (folder.root / "a.bin").read_text() == "1"
    publish(folder, "model", {"a.bin": "3"})
    assert names(folder.root) == ["a.bin", "b.bin"]


def test_files_written_one_by_one_are_ours_before_they_appear(folder: OutputFolder) -> None:
    """A run killed between two of them may write them again."""
    with pytest.raises(KeyboardInterrupt), folder.replacing("images", ["a.png", "b.png"]):
        (folder.root / "a.png").write_text("1")
        raise KeyboardInterrupt
    again = claim(folder.root, "made", "/pictures")
    with again.replacing("images", ["a.png"]):
        (folder.root / "a.png").write_text("2")
    assert names(folder.root) == ["a.png"]


def test_a_run_that_left_nothing_leaves_no_folder(folder: OutputFolder) -> None:
    folder.give_up()
    assert not folder.root.exists()
    kept = claim(folder.root, "made", "/pictures")
    publish(kept, "model", {"a.bin": "1"})
    kept.give_up()
    assert names(folder.root) == ["a.bin"]


@pytest.mark.parametrize(
    ("text", "match"),
    [("", "damaged"), ("[]", "damaged"), ('{"format": 2}', "damaged"), ('{"format": 1}', "another version")],
)
def test_a_mark_that_cannot_be_read_is_an_error(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / MARK).write_text(text)
    with pytest.raises(WorkspaceError, match=match):
        read_mark(tmp_path)
