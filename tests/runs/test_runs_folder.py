"""Output folders: whose they are, what is published, and that nothing of the user's is lost."""

import json
from pathlib import Path

import numpy as np
import pytest

from epipole.errors import WorkspaceError
from epipole.runs.folder import MARK, OutputFolder, claim, read_mark

IMAGES = Path("/pictures")


def names(root: Path) -> list[str]:
    return sorted(p.relative_to(root).as_posix() for p in root.rglob("*") if p.is_file() and p.name != MARK)


@pytest.fixture
def folder(tmp_path: Path) -> OutputFolder:
    return claim(tmp_path / "out", "made", [IMAGES])


def publish(folder: OutputFolder, group: str, files: dict[str, str]) -> None:
    with folder.publish(group) as aside:
        for name, text in files.items():
            (aside / name).parent.mkdir(parents=True, exist_ok=True)
            (aside / name).write_text(text)


def test_a_new_folder_is_marked_with_kind_source_and_version(folder: OutputFolder) -> None:
    mark = json.loads((folder.root / MARK).read_text())
    assert (mark["kind"], mark["source"], mark["files"]) == ("made", ["/pictures"], {})
    assert mark["version"] and mark["format"] == 3


def test_the_same_run_comes_back_and_others_do_not(folder: OutputFolder) -> None:
    publish(folder, "model", {"a.bin": "1"})
    again = claim(folder.root, "made", [IMAGES])
    assert again.files == {"model": ["a.bin"]}
    for kind, source in (("other", IMAGES), ("made", Path("/elsewhere"))):
        with pytest.raises(WorkspaceError, match="contains the results of `epipole made` for /pictures"):
            claim(folder.root, kind, [source])


def test_a_marked_folder_without_results_may_be_taken(folder: OutputFolder) -> None:
    taken = claim(folder.root, "other", [Path("/elsewhere")])
    assert (taken.kind, str(taken.source)) == ("other", "/elsewhere")


def test_folders_of_others_are_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(WorkspaceError, match="not written by epipole"):
        claim(tmp_path, "made", [IMAGES])
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(WorkspaceError, match="is a file"):
        claim(tmp_path / "notes.txt", "made", [IMAGES])


def test_results_do_not_go_among_the_inputs(tmp_path: Path) -> None:
    image = tmp_path / "left.png"
    image.write_bytes(b"")
    for given in (image, tmp_path):
        with pytest.raises(WorkspaceError, match="choose another output folder"):
            claim(tmp_path, "made", [given])
    claim(tmp_path / "out", "made", [image, tmp_path])


def test_results_appear_together_and_stale_ones_go(folder: OutputFolder) -> None:
    publish(folder, "model", {"sparse/0/a.bin": "1", "sparse/1/b.bin": "2", "c.txt": "3"})
    publish(folder, "report", {"report.html": "4"})
    publish(folder, "model", {"sparse/0/a.bin": "5"})
    assert names(folder.root) == ["report.html", "sparse/0/a.bin"]
    assert (folder.root / "sparse/0/a.bin").read_text() == "5"
    assert not (folder.root / "sparse/1").exists()  # nor an empty folder of it
    assert claim(folder.root, "made", [IMAGES]).files == folder.files


def test_a_block_that_fails_changes_nothing(folder: OutputFolder) -> None:
    publish(folder, "model", {"a.bin": "1"})
    with pytest.raises(ZeroDivisionError), folder.publish("model") as aside:
        (aside / "a.bin").write_text("2")
        raise ZeroDivisionError
    assert names(folder.root) == ["a.bin"] and (folder.root / "a.bin").read_text() == "1"


def test_a_file_that_no_run_has_written_is_kept(folder: OutputFolder) -> None:
    publish(folder, "model", {"a.bin": "1"})
    (folder.root / "b.bin").write_text("mine")
    with pytest.raises(WorkspaceError, match=r"contains b\.bin, which was not written by an earlier run"):
        publish(folder, "model", {"a.bin": "2", "b.bin": "2"})
    assert (folder.root / "b.bin").read_text() == "mine" and (folder.root / "a.bin").read_text() == "1"
    publish(folder, "model", {"a.bin": "3"})
    assert names(folder.root) == ["a.bin", "b.bin"]


def test_files_written_one_by_one_are_ours_before_they_appear(folder: OutputFolder) -> None:
    """A run killed between two of them may write them again."""
    with pytest.raises(KeyboardInterrupt), folder.replacing("images", ["a.png", "b.png"]):
        (folder.root / "a.png").write_text("1")
        raise KeyboardInterrupt
    again = claim(folder.root, "made", [IMAGES])
    with again.replacing("images", ["a.png"]):
        (folder.root / "a.png").write_text("2")
    assert names(folder.root) == ["a.png"]


def test_a_run_that_left_nothing_leaves_no_mark(folder: OutputFolder) -> None:
    folder.give_up(has_failed=True)
    assert list(folder.root.iterdir()) == []
    kept = claim(folder.root, "made", [IMAGES])
    publish(kept, "model", {"a.bin": "1"})
    kept.give_up(has_failed=True)
    assert names(folder.root) == ["a.bin"] and not kept.has_failed  # there are results of an earlier run


def test_a_folder_in_which_a_run_failed_is_free(folder: OutputFolder) -> None:
    publish(folder, "database", {"database.db": "1"})
    (folder.root / "notes.txt").write_text("mine")
    folder.give_up(has_failed=True)
    folder.save()
    taken = claim(folder.root, "other", [Path("/elsewhere")])
    assert (taken.kind, str(taken.source), taken.files) == ("other", "/elsewhere", {})
    assert names(folder.root) == ["notes.txt"]


def test_the_work_of_a_stopped_run_is_not_free(folder: OutputFolder) -> None:
    (folder.root / "work").mkdir()
    (folder.root / "work" / "a.npz").write_text("hours")
    folder.give_up(has_failed=False)
    folder.save()
    with pytest.raises(
        WorkspaceError,
        match=r"contains the intermediate files of `epipole made` for /pictures; .* rename them back",
    ):
        claim(folder.root, "made", [Path("/elsewhere")])
    claim(folder.root, "made", [IMAGES])


def test_a_renamed_source_is_known_by_its_files(tmp_path: Path) -> None:
    before, after, out = tmp_path / "photos", tmp_path / "summer, 2024", tmp_path / "out"
    before.mkdir()
    for name, text in (("a.jpg", "1"), ("b.jpg", "22")):
        (before / name).write_text(text)
    publish(claim(out, "made", [before]), "model", {"a.bin": "1"})
    after.mkdir()
    (after / "a.jpg").write_text("1")
    with pytest.raises(WorkspaceError, match="contains the results"):  # both are there: which is it?
        claim(out, "made", [after])
    (after / "a.jpg").unlink()
    after.rmdir()
    before.rename(after)
    assert claim(out, "made", [after]).files == {"model": ["a.bin"]}
    third = after.rename(tmp_path / "third")
    (third / "b.jpg").write_text("another")
    with pytest.raises(WorkspaceError, match="rename them back"):
        claim(out, "made", [third])


def test_what_is_no_file_any_more_is_not_replaced(folder: OutputFolder, tmp_path: Path) -> None:
    """A folder, or a link, that the user has put in the place of a result."""
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    publish(folder, "model", {"a.bin": "1", "b.bin": "1"})
    (folder.root / "a.bin").unlink()
    (folder.root / "a.bin").mkdir()
    (folder.root / "b.bin").unlink()
    (folder.root / "b.bin").symlink_to(mine)
    for name in ("a.bin", "b.bin"):
        with pytest.raises(WorkspaceError, match=rf"{name[0]}\.bin is no longer a file: remove it"):
            publish(folder, "model", {name: "2"})
    publish(folder, "model", {"c.bin": "1"})  # stale now, and left alone
    assert (folder.root / "a.bin").is_dir() and (folder.root / "b.bin").is_symlink()
    assert mine.read_text() == "mine"


def test_nothing_is_written_or_removed_through_a_linked_folder(folder: OutputFolder, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.jpg").write_text("mine")
    publish(folder, "images", {"images/a.jpg": "1"})
    (folder.root / "images" / "a.jpg").unlink()
    (folder.root / "images").rmdir()
    (folder.root / "images").symlink_to(photos)
    with pytest.raises(WorkspaceError, match="does not name a file inside"):
        publish(folder, "images", {"images/a.jpg": "2"})
    publish(folder, "images", {"c.bin": "1"})
    assert (photos / "a.jpg").read_text() == "mine"


@pytest.mark.parametrize("name", ["../mine.txt", "/etc/passwd", "a/../../mine.txt", "", "..", "a\0b"])
def test_a_mark_names_files_of_its_folder_only(folder: OutputFolder, name: str) -> None:
    publish(folder, "model", {"a.bin": "1"})
    mark = json.loads((folder.root / MARK).read_text())
    mark["files"]["model"] = [name]
    (folder.root / MARK).write_text(json.dumps(mark))
    with pytest.raises(WorkspaceError, match="damaged"):
        claim(folder.root, "made", [IMAGES])
    with pytest.raises(WorkspaceError), folder.replacing("images", [name]):
        pytest.fail("a name that leads out")


def test_numbers_that_json_does_not_have_are_null(folder: OutputFolder) -> None:
    folder.write_json(
        "summary.json", {"a": float("nan"), "b": [np.float32("inf"), 1.5], "c": np.array([1.0, np.nan])}
    )

    def refuse(word: str) -> None:
        pytest.fail(f"{word} is no JSON")

    found = json.loads((folder.root / "summary.json").read_text(), parse_constant=refuse)
    assert found == {"a": None, "b": [None, 1.5], "c": [1.0, None]}


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "damaged"),
        ("[]", "damaged"),
        ("[" * 100_000, "damaged"),
        ('{"format": 99}', "another version"),
        ('{"format": 3}', "damaged"),
        ('{"format": 2}', "another version"),
    ],
)
def test_a_mark_that_cannot_be_read_is_an_error(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / MARK).write_text(text)
    with pytest.raises(WorkspaceError, match=match):
        read_mark(tmp_path)


@pytest.mark.parametrize(
    ("added", "removed", "is_known"), [(5, 0, True), (0, 5, True), (40, 0, False), (0, 31, False)]
)
def test_a_renamed_source_may_gain_and_lose_files(
    tmp_path: Path, added: int, removed: int, is_known: bool
) -> None:
    before, after, out = tmp_path / "photos, first", tmp_path / "second", tmp_path / "out"
    before.mkdir()
    for n in range(40):
        (before / f"{n}.jpg").write_text(str(n))
    publish(claim(out, "made", [before]), "model", {"a.bin": "1"})
    for n in range(added):
        (before / f"new {n}.jpg").write_text("new")
    for n in range(removed):
        (before / f"{n}.jpg").unlink()
    before.rename(after)
    if is_known:
        assert claim(out, "made", [after]).files == {"model": ["a.bin"]}
    else:
        with pytest.raises(WorkspaceError, match="rename them back"):
            claim(out, "made", [after])


def test_what_stands_in_a_results_place_is_found_before_the_work(folder: OutputFolder) -> None:
    publish(folder, "model", {"points.ply": "1"})
    (folder.root / "points.ply").unlink()
    (folder.root / "points.ply").mkdir()
    with pytest.raises(WorkspaceError, match=r"points\.ply is no longer a file: remove it"):
        claim(folder.root, "made", [IMAGES])
    (folder.root / "points.ply").rmdir()
    claim(folder.root, "made", [IMAGES])
