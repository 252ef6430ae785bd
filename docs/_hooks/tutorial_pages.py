"""Generates the tutorial pages from examples/NN_name.py.

The module docstring is the title (first line) and the introduction. An unindented comment that precedes a blank line or the end of
the file is Markdown prose, with links relative to the repository root (`docs/pictures/name.jpg`). Everything else is code.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def tutorial_pages(examples: Path = EXAMPLES) -> dict[str, str]:
    """Markdown of all tutorials by page path, ordered by example number."""
    files = sorted(examples.glob("[0-9][0-9]_*.py"))
    return {f"tutorials/{path.stem}.md": tutorial(path) for path in files}


def tutorial(path: Path) -> str:
    """Convert one example to Markdown."""
    source = path.read_text(encoding="utf-8")
    docstring = (ast.get_docstring(ast.parse(source)) or path.stem).strip()
    title, _, intro = docstring.partition("\n")
    parts = [f"# {title.strip().rstrip('.')}", _prose(intro.strip())]
    for kind, text in blocks(source):
        parts.append(_prose(text) if kind == "prose" else f"```python\n{text}\n```")
    parts.append(f"The whole file is `examples/{path.name}`. Run it with `python examples/{path.name}`.")
    return "\n\n".join(part for part in parts if part) + "\n"


def blocks(source: str) -> list[tuple[str, str]]:
    """Split the source after the module docstring into ("prose" or "code", text) blocks, in order."""
    lines = source.splitlines()
    module = ast.parse(source).body
    first = module[0].end_lineno or 0 if module and ast.get_docstring(ast.parse(source)) else 0
    prose = _prose_lines(source, first)
    found: list[tuple[str, list[str]]] = []
    for n in range(first, len(lines)):
        kind = "prose" if n in prose else "code"
        text = lines[n].removeprefix("#").removeprefix(" ") if kind == "prose" else lines[n]
        if not found or found[-1][0] != kind:
            found.append((kind, []))
        found[-1][1].append(text)
    texts = [(kind, "\n".join(rows).strip("\n")) for kind, rows in found]
    return [(kind, text) for kind, text in texts if text.strip()]


def _prose_lines(source: str, first: int) -> set[int]:
    """Zero-based numbers of the comment lines that are prose."""
    lines = source.splitlines()
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {
        token.start[0] - 1 for token in tokens if token.type == tokenize.COMMENT and token.start[1] == 0
    }
    prose: set[int] = set()
    for n in sorted(comments, reverse=True):
        is_last = n + 1 >= len(lines) or not lines[n + 1].strip() or n + 1 in prose
        if n >= first and is_last:
            prose.add(n)
    return prose


def _prose(text: str) -> str:
    return re.sub(r"\]\(docs/", "](../", text)
