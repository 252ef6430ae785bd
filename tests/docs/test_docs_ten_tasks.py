"""Ten common tasks: epipole's lines are no more than the peer's, and give the same results."""

import ast
import builtins
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from docs_pages import PAGES, blocks_of
from docs_setups import usual

TASKS = re.findall(
    r"^## \d+\. .*?(?=^## |\Z)", PAGES["coming_from/ten_tasks"].read_text(), re.MULTILINE | re.DOTALL
)


def lines_of(section: str, peer: str) -> list[str]:
    """Code lines of the block that begins with a comment of this name."""
    (block,) = re.findall(rf"^```python3?\n# (?:{peer})\n(.*?)^```", section, re.MULTILINE | re.DOTALL)
    return [line for line in block.splitlines() if line.strip()]


def test_there_are_ten() -> None:
    assert len(TASKS) == 10


@pytest.mark.parametrize("section", TASKS, ids=[task.splitlines()[0][3:] for task in TASKS])
def test_the_lines_are_no_more_than_the_peers(section: str) -> None:
    assert 1 <= len(lines_of(section, "epipole")) <= len(lines_of(section, "OpenCV|pycolmap"))


def test_every_name_is_explained_or_defined() -> None:
    text = PAGES["coming_from/ten_tasks"].read_text()
    known = {*re.findall(r"`(\w+)`", text.partition("```")[0]), *dir(builtins)}
    for block in re.findall(r"^```python3?\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        nodes = list(ast.walk(ast.parse(block)))
        names = [node for node in nodes if isinstance(node, ast.Name)]
        imported = [
            each for node in nodes if isinstance(node, ast.Import | ast.ImportFrom) for each in node.names
        ]
        known |= {each.asname or each.name for each in imported}
        known |= {node.id for node in names if isinstance(node.ctx, ast.Store)}
        assert {node.id for node in names} <= known, block


def test_the_results_agree(
    reconstructed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unchecked: None
) -> None:
    names: dict[str, Any] = usual(tmp_path, reconstructed)
    monkeypatch.chdir(tmp_path)
    for block in blocks_of(PAGES["coming_from/ten_tasks"], "python"):
        exec(compile(block, "ten_tasks", "exec"), names)
    assert np.allclose(names["undistorted"], names["undistorted_cv"], atol=1e-3)
    motion, unit_t = names["cam2_from_cam1"], names["t"] / np.linalg.norm(names["t"])
    assert np.allclose(motion.rotation, names["R"], atol=1e-6) and np.allclose(
        motion.translation, unit_t, atol=1e-6
    )
    assert np.allclose(names["R_cv"], names["R"], atol=1e-3)
    assert np.allclose(
        names["F"] / names["F"][2, 2], names["F_cv"] / names["F_cv"][2, 2], rtol=1e-2, atol=1e-6
    )
    assert np.allclose(names["H"] / names["H"][2, 2], names["H_cv"], atol=1e-4)
    assert np.allclose(names["cam_from_world"].rotation, names["R_pnp"], atol=1e-4)
    assert np.allclose(names["points"], names["X"], atol=1e-6) and np.allclose(
        names["X_cv"], names["X"], atol=1e-2
    )
    assert len(names["pairs"]) > 50 and len(names["pairs_cv"]) > 50
    both = np.isfinite(names["depth"]) & np.isfinite(names["depth_cv"])
    assert both.mean() > 0.5
    assert np.median(np.abs(names["depth"] / names["depth_cv"] - 1)[both]) < 0.1
    assert names["adjusted"].final_cost < 1e-10
