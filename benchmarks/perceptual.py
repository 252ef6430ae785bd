"""LPIPS (Zhang et al. 2018) of the held-out views rendered by `splat` or `nerf`.

    pip install -e '.[bench]' && pip install lpips
    python -m benchmarks.perceptual OUT TRUTH [--net alex]

OUT is an output folder with `test/NAME.png`; TRUTH has images with the same names and sizes. The package `lpips` needs PyTorch,
and downloads network weights at its first use.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG")


def pairs_of(out: Path, truth: Path) -> list[tuple[str, Path, Path]]:
    """Name, rendered image and true image of each view that both folders have."""
    found = []
    for rendered in sorted((out / "test").rglob("*.png")):
        name = rendered.relative_to(out / "test").with_suffix("")
        true = next((p for s in SUFFIXES if (p := truth / name.parent / f"{name.name}{s}").is_file()), None)
        if true is not None:
            found.append((name.as_posix(), rendered, true))
    return found


def network(name: str) -> Any:
    """The LPIPS metric; exits with a message if the package or its weights are missing."""
    try:
        import lpips
    except ImportError:
        sys.exit("LPIPS needs the package lpips and PyTorch: run `pip install lpips`.")
    try:
        return lpips.LPIPS(net=name, verbose=False)
    except Exception as error:  # noqa: BLE001 - the download can fail in many ways
        sys.exit(f"Cannot load the weights of {name}: {error}")


def tensor(path: Path) -> Any:
    """An image as (1, 3, h, w) from -1 to 1, on a white background."""
    import torch

    rgba = np.asarray(Image.open(path).convert("RGBA"), np.float32) / 255.0
    rgb = rgba[..., :3] * rgba[..., 3:] + 1.0 - rgba[..., 3:]
    return torch.from_numpy(2.0 * rgb.transpose(2, 0, 1)[None] - 1.0)


def main() -> None:
    """Print the metric of each view and the mean."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--net", choices=["alex", "vgg", "squeeze"], default="alex")
    arguments = parser.parse_args()
    pairs = pairs_of(arguments.out, arguments.truth)
    if not pairs:
        sys.exit(f"No image in {arguments.truth} has the name of a view in {arguments.out / 'test'}.")
    metric, values = network(arguments.net), []
    for name, rendered, true in pairs:
        values.append(float(metric(tensor(rendered), tensor(true)).item()))
        print(f"{name}\t{values[-1]:.4f}")
    print(f"mean of {len(values)}\t{np.mean(values):.4f}")


if __name__ == "__main__":
    main()
