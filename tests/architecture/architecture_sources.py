"""The package's sources as syntax trees, read once."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import epipole

PACKAGE = Path(epipole.__file__).parent
REPOSITORY = PACKAGE.parents[1]
Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Source:
    """One module."""

    path: Path
    text: str
    tree: ast.Module

    @property
    def name(self) -> str:
        """Path inside the package, with forward slashes."""
        return self.path.relative_to(PACKAGE).as_posix()

    @property
    def room(self) -> str:
        """The top-level room; modules beside the rooms are rooms of their own."""
        return self.path.relative_to(PACKAGE).parts[0].removesuffix(".py")

    @property
    def is_private(self) -> bool:
        """The file or a folder of it begins with an underscore."""
        return any(part.startswith("_") and part != "__init__.py" for part in Path(self.name).parts)

    @cached_property
    def nodes(self) -> tuple[ast.AST, ...]:
        """All nodes of the tree, collected once for all tests."""
        return tuple(ast.walk(self.tree))

    @property
    def is_kernels(self) -> bool:
        return self.path.name.startswith("_") and self.path.name.endswith("_kernels.py")


@cache
def sources() -> tuple[Source, ...]:
    paths = sorted(PACKAGE.rglob("*.py"))
    return tuple(Source(p, text := p.read_text(encoding="utf-8"), ast.parse(text)) for p in paths)


def functions(source: Source) -> Iterator[tuple[str, Function]]:
    """Every function and method with its dotted name; functions inside functions are their own affair."""

    def visit(node: ast.AST, prefix: str) -> Iterator[tuple[str, Function]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, Function):
                yield prefix + child.name, child
            elif isinstance(child, ast.ClassDef):
                yield from visit(child, prefix + child.name + ".")
            elif isinstance(child, ast.If | ast.Try):
                yield from visit(child, prefix)

    yield from visit(source.tree, "")


def classes(source: Source) -> Iterator[ast.ClassDef]:
    return (node for node in source.nodes if isinstance(node, ast.ClassDef))


def is_public(name: str) -> bool:
    """Every part of a dotted name is public; the special methods are the interface of their class."""
    return all(not part.startswith("_") or part in ("__matmul__", "__getitem__") for part in name.split("."))


def parameters(function: Function, *, own: bool = True) -> list[ast.arg]:
    """All parameters, without self and cls."""
    a = function.args
    named = [*a.posonlyargs, *a.args, *a.kwonlyargs]
    extra = [x for x in (a.vararg, a.kwarg) if x is not None]
    return [x for x in [*named, *extra] if not (own and x.arg in ("self", "cls"))]


@cache
def _documented_methods() -> dict[str, tuple[frozenset[str], tuple[str, ...]]]:
    """Of every class by its name: the methods with a docstring, and the names of its bases.

    Classes of one name count as one.
    """
    found: dict[str, tuple[frozenset[str], tuple[str, ...]]] = {}
    for source in sources():
        for node in classes(source):
            methods = [n for n in node.body if isinstance(n, Function) and ast.get_docstring(n)]
            bases = tuple(ast.unparse(base).split(".")[-1] for base in node.bases)
            known, more = found.get(node.name, (frozenset(), ()))
            found[node.name] = (known | {method.name for method in methods}, more + bases)
    return found


def is_documented(name: str, function: Function) -> bool:
    """It has a docstring, or is a method that a base class describes."""
    if ast.get_docstring(function):
        return True
    *owner, method = name.split(".")
    bases = list(owner[-1:])
    while bases:
        methods, more = _documented_methods().get(bases.pop(), (frozenset(), ()))
        if method in methods:
            return True
        bases += more
    return False
