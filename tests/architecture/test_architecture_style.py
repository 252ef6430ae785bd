"""Names, sizes, documentation, annotations: what a reader of any file can rely on."""

import ast
import re
from collections import Counter
from collections.abc import Iterator

from architecture_sources import PACKAGE, classes, functions, is_documented, is_public, parameters, sources

# Alone, these words do not tell from which frame to which.
BANNED = {
    *("pose", "poses", "extrinsic", "extrinsics", "transform", "transforms", "transformation", "matrix_4x4"),
    *("c2w", "w2c", "T", "Rt", "RT", "pts", "img", "imgs", "intrinsics_matrix"),
}
MAX_LINES, MAX_FILES, MAX_FUNCTION, MAX_KERNEL, MAX_PARAMETERS = 400, 25, 60, 120, 7


def public_names() -> Iterator[tuple[str, str]]:
    """(place, name) of all functions, classes, fields and parameters that a user may see."""
    for source in sources():
        if source.is_private:
            continue
        for name, function in functions(source):
            if is_public(name):
                yield f"{source.name}:{function.lineno}", function.name
                yield from ((f"{source.name}:{p.lineno}", p.arg) for p in parameters(function))
        for node in classes(source):
            if is_public(node.name):
                yield f"{source.name}:{node.lineno}", node.name
                fields = [n.target for n in node.body if isinstance(n, ast.AnnAssign)]
                names = [t for t in fields if isinstance(t, ast.Name) and not t.id.startswith("_")]
                yield from ((f"{source.name}:{t.lineno}", t.id) for t in names)


def test_names_tell_their_frames() -> None:
    wrong = [f"{position} {name}" for position, name in public_names() if name in BANNED]
    assert not wrong, "\n".join(wrong)


def test_names_of_directions_are_written_target_from_source() -> None:
    """Nobody can tell which way `cam_to_world` goes in a product."""
    wrong = [
        f"{position} {name}"
        for position, name in public_names()
        if re.search(r"(cam|world|rig|body)\d?_to_", name)
    ]
    assert not wrong, "\n".join(wrong)


def test_quaternions_tell_their_order() -> None:
    found = [(position, name) for position, name in public_names() if re.search(r"quat", name)]
    wrong = [f"{position} {name}" for position, name in found if not name.endswith(("_wxyz", "_xyzw"))]
    assert found and not wrong, "\n".join(wrong)


def test_everything_public_is_documented() -> None:
    wrong = []
    for source in sources():
        if not ast.get_docstring(source.tree):
            wrong.append(f"{source.name} has no docstring")
        for node in classes(source):
            if is_public(node.name) and not ast.get_docstring(node):
                wrong.append(f"{source.name}:{node.lineno} class {node.name}")
        for name, function in functions(source):
            if is_public(name) and not is_documented(name, function):
                wrong.append(f"{source.name}:{function.lineno} {name}")
    assert not wrong, "\n".join(wrong)


def test_kernels_say_what_they_compute() -> None:
    kernels = [s for s in sources() if s.is_kernels]
    assert kernels
    for source in kernels:
        for name, function in functions(source):
            assert is_documented(name, function) or not is_public(name), f"{source.name} {name}"


def test_everything_public_is_annotated() -> None:
    wrong = []
    for source in sources():
        if source.is_kernels:
            continue
        for name, function in functions(source):
            if not is_public(name):
                continue
            missing = [p.arg for p in parameters(function) if p.annotation is None]
            missing += ["the result"] if function.returns is None else []
            wrong += [f"{source.name}:{function.lineno} {name}: {m}" for m in missing]
        for node in classes(source):
            inits = [f for f in node.body if isinstance(f, ast.FunctionDef) and f.name == "__init__"]
            for init in inits:
                missing = [p.arg for p in parameters(init) if p.annotation is None]
                wrong += [f"{source.name}:{init.lineno} {node.name}: {m}" for m in missing]
    assert not wrong, "\n".join(wrong)


def test_files_are_short() -> None:
    lengths = {s.name: len(s.text.splitlines()) for s in sources()}
    wrong = {name: lines for name, lines in lengths.items() if lines > MAX_LINES}
    assert not wrong, wrong
    assert sorted(lengths.values())[len(lengths) // 2] < 180


def test_folders_are_small() -> None:
    folders = Counter(source.path.parent.relative_to(PACKAGE).as_posix() for source in sources())
    assert len(folders) > 40
    wrong = {folder: files for folder, files in folders.items() if files > MAX_FILES}
    assert not wrong, wrong


def test_functions_are_short() -> None:
    wrong = []
    for source in sources():
        limit = MAX_KERNEL if source.is_kernels else MAX_FUNCTION
        for node in source.nodes:
            if isinstance(node, ast.FunctionDef) and (lines := node.end_lineno - node.lineno + 1) > limit:
                wrong.append(f"{source.name}:{node.lineno} {node.name}: {lines} lines")
    assert not wrong, "\n".join(wrong)


def test_no_tuple_is_unpacked_to_shorten_a_call() -> None:
    """`f(*(a, b), c)` hides which parameter is which."""
    wrong = [
        f"{source.name}:{node.lineno}"
        for source in sources()
        for node in source.nodes
        if isinstance(node, ast.Starred) and isinstance(node.value, ast.Tuple)
    ]
    assert not wrong, "\n".join(wrong)


def test_functions_have_few_parameters() -> None:
    wrong = []
    for source in sources():
        if source.is_kernels:
            continue
        for name, function in functions(source):
            if is_public(name) and (count := len(parameters(function))) > MAX_PARAMETERS:
                wrong.append(f"{source.name}:{function.lineno} {name}: {count}")
    assert not wrong, "\n".join(wrong)


def test_only_the_command_line_prints() -> None:
    wrong = []
    for source in sources():
        if source.room in ("cli", "_terminal") or source.path.name == "command.py":
            continue
        for node in source.nodes:
            if isinstance(node, ast.Call) and ast.unparse(node.func) in (
                "print",
                "sys.stdout.write",
                "sys.exit",
            ):
                wrong.append(f"{source.name}:{node.lineno} {ast.unparse(node.func)}")
    assert not wrong, "\n".join(wrong)


def data_classes() -> Iterator[tuple[str, ast.ClassDef, dict[str, str]]]:
    """(place, class, options of its decorator) of all data classes outside the files of options."""
    for source in sources():
        if source.path.name == "config.py":
            continue
        for node in classes(source):
            for decorator in node.decorator_list:
                if ast.unparse(decorator).startswith("dataclass"):
                    keywords = getattr(decorator, "keywords", [])
                    options = {k.arg: ast.unparse(k.value) for k in keywords}
                    yield f"{source.name}:{node.lineno} {node.name}", node, options


def test_public_data_are_frozen_and_have_slots() -> None:
    """A mutable builder is private to its file."""
    wrong, seen = [], 0
    for position, node, options in data_classes():
        seen += 1
        frozen = options.get("frozen") == "True" or not is_public(node.name)
        if not frozen or options.get("slots") != "True":
            wrong.append(f"{position}: {options}")
    assert seen > 5 and not wrong, "\n".join(wrong)


def test_data_that_hold_arrays_are_not_compared() -> None:
    """`==` of arrays is no truth value; what holds arrays, itself or in its parts, is compared by identity."""
    parts = {}
    for position, node, options in data_classes():
        fields = " ".join(ast.unparse(n.annotation) for n in node.body if isinstance(n, ast.AnnAssign))
        parts[node.name] = (position, set(re.findall(r"\w+", fields)), options.get("eq") == "False")
    fitting, grown = {"ndarray"}, True
    while grown:
        found = {name for name, (_, words, _) in parts.items() if words & fitting}
        grown = not found <= fitting
        fitting |= found
    assert {"Rigid3", "Camera", "Reconstruction"} <= fitting
    public = {name: part for name, part in parts.items() if is_public(name) and name in fitting}
    wrong = [position for position, _, by_identity in public.values() if not by_identity]
    assert not wrong, "\n".join(wrong)


def test_errors_are_few_and_of_one_family() -> None:
    (errors,) = (s for s in sources() if s.name == "errors.py")
    names = {node.name for node in classes(errors)}
    assert "EpipoleError" in names and len(names) <= 9
    for node in classes(errors):
        assert node.name == "EpipoleError" or ast.unparse(node.bases[0]) == "EpipoleError", node.name
    # What the interpreter or a caller inside the package expects.
    allowed = {*names, "AttributeError", "SystemExit", "KeyboardInterrupt"}
    wrong = []
    for source in sources():
        for name, function in functions(source):
            if source.is_private or not is_public(name):
                continue
            for node in ast.walk(function):
                if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                    raised = ast.unparse(node.exc.func).split(".")[-1]
                    if raised.endswith(("Error", "Exception")) and raised not in allowed:
                        wrong.append(f"{source.name}:{node.lineno} raises {raised}")
    assert not wrong, "\n".join(wrong)


def test_nothing_is_left_unfinished() -> None:
    pattern = re.compile(r"\b(TODO|FIXME|XXX|HACK|NotImplementedError)\b")
    wrong = [
        f"{s.name}:{n}"
        for s in sources()
        for n, line in enumerate(s.text.splitlines(), 1)
        if pattern.search(line)
    ]
    assert not wrong, "\n".join(wrong)
