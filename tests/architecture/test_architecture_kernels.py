"""Every kernel that Python calls has a test that compares it with a reference."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from architecture_sources import PACKAGE, REPOSITORY, classes, sources

Kernel = tuple[str, str]
"""Module and name."""


@dataclass(frozen=True)
class Module:
    """A module's name and syntax tree."""

    name: str
    tree: ast.Module

    @property
    def is_kernels(self) -> bool:
        last = self.name.rpartition(".")[2]
        return last.startswith("_") and last.endswith("_kernels")


def package_modules() -> list[Module]:
    return [Module(".".join((PACKAGE.name, *Path(s.name).with_suffix("").parts)), s.tree) for s in sources()]


def is_kernel(decorator: ast.expr) -> bool:
    """`@kernel` or `@kernel(...)`."""
    called = decorator.func if isinstance(decorator, ast.Call) else decorator
    return isinstance(called, ast.Name) and called.id == "kernel"


def defined_kernels(modules: list[Module]) -> set[Kernel]:
    return {
        (module.name, node.name)
        for module in modules
        for node in ast.walk(module.tree)
        if isinstance(node, ast.FunctionDef) and any(is_kernel(d) for d in node.decorator_list)
    }


def imported(module: Module) -> dict[str, str]:
    """What the names mean that a module imports from others."""
    return {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in ast.walk(module.tree)
        if isinstance(node, ast.ImportFrom) and node.level == 0
        for alias in node.names
    }


def named(tree: ast.AST, names: dict[str, str], kernels: set[Kernel]) -> Iterator[Kernel]:
    """The kernels that stand in a piece of source, as `name` or `module.name`."""
    for node in ast.walk(tree):
        full = ""
        if isinstance(node, ast.Name):
            full = names.get(node.id, "")
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            full = f"{names.get(node.value.id, '')}.{node.attr}"
        module, _, name = full.rpartition(".")
        if (module, name) in kernels:
            yield module, name


def called_from_python(modules: list[Module]) -> set[Kernel]:
    kernels = defined_kernels(modules)
    callers = [module for module in modules if not module.is_kernels]
    return {kernel for module in callers for kernel in named(module.tree, imported(module), kernels)}


def references(test: ast.AST) -> Iterator[ast.Call]:
    """The decorators `@reference_of(...)` of a test."""
    if isinstance(test, ast.FunctionDef) and test.name.startswith("test_"):
        for decorator in test.decorator_list:
            called = decorator.func if isinstance(decorator, ast.Call) else decorator
            if isinstance(called, ast.Name) and called.id == "reference_of":
                yield decorator


def with_a_reference(tests: list[Module], kernels: set[Kernel]) -> set[Kernel]:
    """The kernels that are named in `@reference_of(...)`."""
    found: set[Kernel] = set()
    for module in tests:
        names = imported(module)
        for test in module.tree.body:
            for decorator in references(test):
                found.update(named(decorator, names, kernels))
    return found


def test_every_kernel_that_python_calls_has_a_reference() -> None:
    modules = package_modules()
    kernels = called_from_python(modules)
    assert len(kernels) > 50
    tests = [
        Module(path.stem, ast.parse(path.read_text(encoding="utf-8")))
        for path in (REPOSITORY / "tests").rglob("test_*.py")
    ]
    without = kernels - with_a_reference(tests, kernels)
    assert not without, "\n".join(f"{module}.{name}" for module, name in sorted(without))


KERNELS = """
from epipole._jit import kernel
@kernel
def one(x): return two(x)
@kernel(inline=True)
def two(x): return x
@kernel(allocates=True)
def three(x): return x
def four(x): return x
"""
CALLER = """
from epipole.room import _x_kernels as kernels
from epipole.room._x_kernels import three as third, four
def face(x): return kernels.one(x) + third(x) + four(x)
"""
TEST = """
from epipole.room import _x_kernels
from epipole.room._x_kernels import three
from kernel_references import reference_of
@reference_of(_x_kernels.one)
def test_one(): three(1)
@reference_of(three)
def not_a_test(): pass
"""


def test_the_search_finds_what_it_should() -> None:
    module, caller = Module("epipole.room._x_kernels", ast.parse(KERNELS)), Module("x", ast.parse(CALLER))
    called = called_from_python([module, caller])
    assert called == {(module.name, "one"), (module.name, "three")}
    assert with_a_reference([Module("test_x", ast.parse(TEST))], called) == {(module.name, "one")}


def test_no_field_is_named_as_a_method_of_problems() -> None:
    """Inside kernels such a name means the method, of whatever named tuple."""
    (problems,) = (s for s in sources() if s.name == "robust/_problem_kernels.py")
    methods = {
        function.name
        for node in classes(problems)
        for function in node.body
        if isinstance(function, ast.FunctionDef)
    }
    assert {"score", "near", "refine"} <= methods
    wrong = []
    for source in sources():
        for node in classes(source):
            if "NamedTuple" in [ast.unparse(base) for base in node.bases] and source.path.name[0] == "_":
                fields = [n.target.id for n in node.body if isinstance(n, ast.AnnAssign)]
                wrong += [f"{source.name} {node.name}.{name}" for name in fields if name in methods]
    assert not wrong, "\n".join(wrong)
