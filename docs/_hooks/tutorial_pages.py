"""Tutorials made of examples/NN_name.py.

The first line of the module's docstring is the title, the rest the introduction. A comment at the margin with an empty line (or the
end) after it is prose, Markdown included: images and links are written from the repository's root, `docs/pictures/name.jpg`. All
else, comments that belong to a line of code included, is shown as code.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def tutorial_pages(examples: Path = EXAMPLES) -> dict[str, str]:
    """Markdown by path, in the order of the numbers."""
    files = sorted(examples.glob("[0-9][0-9]_*.py"))
    return {f"tutorials/{path.stem}.md": tutorial(path) for path in files}


def tutorial(path: Path) -> str:
    """One example as a page."""
    source = path.read_text(encoding="utf-8")
    words = (ast.get_docstring(ast.parse(source)) or path.stem).strip()
    title, _, intro = words.partition("\n")
    parts = [f"# {title.strip().rstrip('.')}", _prose(intro.strip())]
    for kind, text in blocks(source):
        parts.append(_prose(text) if kind == "prose" else f"```python\n{text}\n```")
    parts.append(f"The whole file is `examples/{path.name}`; `python examples/{path.name}` runs it.")
    return "\n\n".join(part for part in parts if part) + "\n"


def blocks(source: str) -> list[tuple[str, str]]:
    """Prose and code after the module's docstring, in order."""
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
    """Numbers, from 0, of the lines of comments that stand by themselves at the margin."""
    lines = source.splitlines()
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {
        token.start[0] - 1 for token in tokens if token.type == tokenize.COMMENT and token.start[1] == 0
    }
    prose: set[int] = set()
    for n in sorted(comments, reverse=True):
        alone = n + 1 >= len(lines) or not lines[n + 1].strip() or n + 1 in prose
        if n >= first and alone:
            prose.add(n)
    return prose


def _prose(text: str) -> str:
    return re.sub(r"\]\(docs/", "](../", text)
