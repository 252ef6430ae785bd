"""Imports go down only, and kernels are private to their room."""

import ast
import importlib
import subprocess
import sys
import tomllib
from collections.abc import Iterator

from architecture_sources import PACKAGE, REPOSITORY, Source, sources


def layers() -> list[list[str]]:
    """The rooms of the contract, from the top down; siblings together."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    contract, _ = project["tool"]["importlinter"]["contracts"]
    return [[room.strip(" ()") for room in layer.split("|")] for layer in contract["layers"]]


def imported_modules(source: Source) -> Iterator[str]:
    """Every epipole module that a file names in an import, wherever the import stands."""
    for node in source.nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{source.name}:{node.lineno} imports relatively"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def is_kernels(module: str) -> bool:
    last = module.rsplit(".", 1)[-1]
    return last.startswith("_") and last.endswith("_kernels")


def test_import_linter_keeps_the_contract() -> None:
    code = "import sys; from importlinter.cli import lint_imports_command; sys.exit(lint_imports_command())"
    done = subprocess.run(
        [sys.executable, "-c", code, "--no-cache"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0 and "2 kept, 0 broken" in done.stdout, done.stdout + done.stderr


def test_the_contract_names_every_room() -> None:
    """A room that is missing in the contract would be free to import anything."""
    there = {s.room for s in sources()} - {"__init__"}
    named = {room for layer in layers() for room in layer}
    assert there <= named, f"not in the contract: {sorted(there - named)}"


def test_imports_go_down() -> None:
    """The same as the linter, without its parser; local and conditional imports count as well."""
    height = {room: -rank for rank, layer in enumerate(layers()) for room in layer}
    wrong = []
    for source in sources():
        if source.room == "__init__":
            continue
        for module in imported_modules(source):
            parts = module.split(".")
            if parts[0] != "epipole" or len(parts) < 2 or parts[1] not in height:
                continue
            if parts[1] != source.room and height[parts[1]] >= height[source.room]:
                wrong.append(f"{source.name} imports {module}")
    assert not wrong, "\n".join(wrong)


def test_no_imports_in_a_circle() -> None:
    """No module leads back to itself, wherever its imports stand; an `__init__` only gathers names."""
    names = {"epipole." + s.name.removesuffix(".py").replace("/", "."): s for s in sources()}
    modules = {name: s for name, s in names.items() if not name.endswith("__init__")}
    below = {name: set(imported_modules(s)) & modules.keys() for name, s in modules.items()}
    while any(leaves := [name for name, others in below.items() if not others]):
        below = {name: others - set(leaves) for name, others in below.items() if others}
    assert not below, "\n".join(f"{name} <-> {sorted(others)}" for name, others in below.items())


def test_kernels_are_imported_by_kernels_and_by_their_own_room_only() -> None:
    wrong = []
    for source in sources():
        for module in imported_modules(source):
            parts = module.split(".")
            if not (parts[0] == "epipole" and any(is_kernels(part) for part in parts)):
                continue
            if not source.is_kernels and parts[1] != source.room:
                wrong.append(f"{source.name} imports {module}")
    assert not wrong, "\n".join(wrong)


def test_kernel_files_import_little() -> None:
    """NumPy, the standard library, the decorator, other kernels and private modules of the room: no result class."""
    allowed = {
        "numpy",
        "numba",
        "llvmlite",
        "math",
        "ctypes",
        "contextlib",
        "inspect",
        "typing",
        "__future__",
    }
    wrong = []
    for source in sources():
        if not source.is_kernels:
            continue
        for node in source.nodes:
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
                if names == [f"epipole.{source.room}"]:  # from epipole.room import _x_kernels
                    names = [f"{names[0]}.{alias.name}" for alias in node.names]
            else:
                continue
            for name in names:
                fine = name.split(".")[0] in allowed or name.startswith("epipole._jit") or is_kernels(name)
                fine = fine or name.startswith(f"epipole.{source.room}._")
                if not fine:
                    wrong.append(f"{source.name} imports {name}")
    assert not wrong, "\n".join(wrong)


def test_private_modules_stay_in_their_room() -> None:
    shared = {"_checks", "_jit", "_simd_kernels", "_parallel", "_version"}
    wrong = []
    for source in sources():
        for module in imported_modules(source):
            parts = module.split(".")
            if parts[0] != "epipole" or not any(p.startswith("_") and not is_kernels(p) for p in parts[2:]):
                continue
            if parts[1] not in shared and parts[1] != source.room:
                wrong.append(f"{source.name} imports {module}")
    assert not wrong, "\n".join(wrong)


def test_numba_is_configured_in_one_place() -> None:
    for source in sources():
        if source.room == "_jit":
            continue
        assert "parallel=True" not in source.text and "prange" not in source.text, source.name
        assert "fastmath=" not in source.text.replace("extra_fastmath=", ""), source.name
        assert "njit(" not in source.text and "@njit" not in source.text, source.name


def test_there_is_one_thread_pool() -> None:
    """One for chunks of arrays, the executor of units, and SLAM's mapping thread, whose threads run their chunks inline."""
    found = {s.name for s in sources() if "PoolExecutor(" in s.text}
    assert found == {"_parallel.py", "runs/executors.py", "pipelines/slam/mapping_thread.py"}


def test_nothing_is_called_utils() -> None:
    names = {s.path.stem for s in sources()} | {s.path.parent.name for s in sources()}
    assert not names & {"utils", "util", "helpers", "common", "misc"}


def test_every_room_can_be_reached_from_the_package() -> None:
    import epipole

    for folder in sorted(p.parent.name for p in PACKAGE.glob("*/__init__.py")):
        if folder != "cli" and not folder.startswith("_"):
            assert getattr(epipole, folder) is importlib.import_module(f"epipole.{folder}")


def test_there_is_no_circle_of_imports() -> None:
    """Imports inside functions count as well; those for type checkers do not, but in the package's face."""
    names = {module_name(s): s for s in sources()}
    edges = {name: set(direct_imports(source, set(names))) - {name} for name, source in names.items()}
    edges["epipole"] = set()  # its names are looked up when they are asked for
    done: set[str] = set()
    while free := {name for name in edges if name not in done and edges[name] <= done}:
        done |= free
    left = set(edges) - done
    while above := {name for name in left if not any(name in edges[other] for other in left)}:
        left -= above
    assert not left, f"in a circle: {sorted(left)}"


def direct_imports(source: Source, names: set[str]) -> Iterator[str]:
    """The modules that the import statements of a file load; of `from package import module`, the module."""
    for node in source.nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in names)
        elif isinstance(node, ast.ImportFrom) and node.module in names:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in names else node.module


def module_name(source: Source) -> str:
    parts = ["epipole", *source.path.relative_to(PACKAGE).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def test_a_pipeline_holds_what_a_pipeline_has() -> None:
    for folder in (PACKAGE / "pipelines").iterdir():
        if (folder / "__init__.py").is_file():
            assert {"run.py", "command.py"} <= {p.name for p in folder.iterdir()}, folder.name
