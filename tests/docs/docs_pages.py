"""README.md and the pages under docs/: their fenced blocks and the command lines in these."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = {
    "README": ROOT / "README.md",
    **{path.relative_to(DOCS).with_suffix("").as_posix(): path for path in sorted(DOCS.rglob("*.md"))},
}
"""By path below docs/, without the suffix."""
_FENCE = re.compile(
    r"^(?P<indent> *)```(?P<language>\w*)[^\n]*\n(?P<body>.*?)^ *```$", re.MULTILINE | re.DOTALL
)


def blocks_of(page: Path, *languages: str) -> list[str]:
    """Fenced blocks of these languages; the empty word is a block without one."""
    text = page.read_text(encoding="utf-8")
    return [found["body"] for found in _FENCE.finditer(text) if found["language"] in languages]


def command_blocks(page: Path) -> list[list[str]]:
    """For each block of the shell with lines of `epipole ...` these lines, without comments; one that ends in a backslash goes on."""
    blocks = []
    for block in blocks_of(page, "", "bash", "sh", "shell", "console"):
        lines = [line.strip().removeprefix("$ ") for line in block.replace("\\\n", " ").splitlines()]
        found = [shlex.split(line, comments=True) for line in lines if line.startswith("epipole ")]
        if found:
            blocks.append([shlex.join(words) for words in found])
    return blocks
