"""LPIPS (Zhang et al. 2018) of the held-out views that `splat` or `nerf` has drawn: a learnt measure, beside PSNR and SSIM.

    pip install -e '.[bench]' && pip install lpips
    python -m benchmarks.perceptual OUT TRUTH [--net alex]

OUT is an output folder with `test/NAME.png`, TRUTH a folder with images of the same names in the same size. The package
`lpips` needs PyTorch and weights of a network, which it loads by itself from elsewhere when it is first used: epipole never
imports it, and says so where one of them is missing.
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
    """Name, drawn image and true one of each view that both folders have."""
    found = []
    for rendered in sorted((out / "test").rglob("*.png")):
        name = rendered.relative_to(out / "test").with_suffix("")
        real = next((p for s in SUFFIXES if (p := truth / name.parent / f"{name.name}{s}").is_file()), None)
        if real is not None:
            found.append((name.as_posix(), rendered, real))
    return found


def network(name: str) -> Any:
    """The measure, or an end in words where it cannot be had."""
    try:
        import lpips
    except ImportError:
        sys.exit("LPIPS needs the package lpips and PyTorch: pip install lpips")
    try:
        return lpips.LPIPS(net=name, verbose=False)
    except Exception as error:  # noqa: BLE001 - whatever the loader of the weights meets
        sys.exit(f"the weights of {name} cannot be loaded here: {error}")


def tensor(path: Path) -> Any:
    """An image as (1, 3, h, w) from -1 to 1; what is transparent is white."""
    import torch

    rgba = np.asarray(Image.open(path).convert("RGBA"), np.float32) / 255.0
    rgb = rgba[..., :3] * rgba[..., 3:] + 1.0 - rgba[..., 3:]
    return torch.from_numpy(2.0 * rgb.transpose(2, 0, 1)[None] - 1.0)


def main() -> None:
    """Measure all views and print them with their mean."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--net", choices=["alex", "vgg", "squeeze"], default="alex")
    arguments = parser.parse_args()
    pairs = pairs_of(arguments.out, arguments.truth)
    if not pairs:
        sys.exit(f"no view of {arguments.out / 'test'} has an image of its name in {arguments.truth}")
    measure, values = network(arguments.net), []
    for name, rendered, real in pairs:
        values.append(float(measure(tensor(rendered), tensor(real)).item()))
        print(f"{name}\t{values[-1]:.4f}")
    print(f"mean of {len(values)}\t{np.mean(values):.4f}")


if __name__ == "__main__":
    main()
