"""Damaged files of every format, read in a process that may die: what `make fuzz` does for longer."""

import ast
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import run

from whole import IS_WHOLE, in_whole_run

pytestmark = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is limited as on Linux")

SOURCES = Path(__file__).parents[2] / "src" / "epipole"
CASES = 5000 if IS_WHOLE else 200
SEED = 1
WITHOUT_FILES = {"pair_folders", "pair_within", "list_photographs"}
"""They list folders, and read none of the files in them."""
BY_WAY_OF_OTHERS = {
    "read_image_set",
    "read_image",
    "read_json",
    "read_archive",
    "read_by_others",
    "read_packed_arrays",
    "read_binary",
    "read_matrix_camera",
    "stored_pixels",
    "stored_size",
}
"""They hand their file to readers that are in the table."""
VERBS = (
    "read_",
    "extract_",
    "convert_",
    "load",
    "stored_",
    "find_model",
    "frame_size",
    "copy_or_",
    "pair_folders",
    "pair_within",
    "list_ph",
)


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[run.Finding], Path]:
    """The findings in all formats, and the folder of the last damaged file of each."""
    kept = tmp_path_factory.mktemp("kept")
    return run.search(run.tasks_of(CASES, SEED), kept), kept


def test_damaged_files_end_in_a_clear_error_or_a_sound_object(
    searched: tuple[list[run.Finding], Path],
) -> None:
    found, _ = searched
    assert not found, "\n\n".join(map(str, found))


def test_no_reader_is_left_out() -> None:
    """Every public function whose name says that it reads files."""
    names = set()
    for room in ("io", "pipelines", "runs"):
        for path in (SOURCES / room).rglob("*.py"):
            if path.name.startswith("_") and path.name != "__init__.py":
                continue
            body = ast.parse(path.read_text(encoding="utf-8")).body
            names |= {f.name for f in body if isinstance(f, ast.FunctionDef) and f.name.startswith(VERBS)}
    known = {reader for _, readers in run.formats().values() for reader in readers}
    missing = names - known - WITHOUT_FILES - BY_WAY_OF_OTHERS
    assert not missing, f"add to FORMATS in tests/fuzz/formats.py: {sorted(missing)}"
    assert {"read_colmap_model", "read_database", "read_calibration"} <= names & known


@in_whole_run
def test_a_case_is_repeated_to_the_byte(searched: tuple[list[run.Finding], Path], tmp_path: Path) -> None:
    format_, file = "transforms-all", Path("transforms-all") / "transforms.json"
    last = next(stop - 1 for name, _, _, stop in run.tasks_of(CASES, SEED) if name == format_)
    run.search([[format_, SEED, last, last + 1]], tmp_path)
    _, kept = searched
    assert (tmp_path / file).read_bytes() == (kept / file).read_bytes()
