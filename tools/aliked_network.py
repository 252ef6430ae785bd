"""ALIKED-n16 (Zhao et al., IEEE TIM 2023) as torch modules that ONNX can express, for convert_learned_features.py.

The published code computes deformable convolutions by an operator of torchvision that ONNX lacks before version 19, and
onnxruntime on CPUs. Here they are bilinear samples, one per element of the kernel, and convolutions of a single pixel. The
names of the published weights (https://github.com/Shiaoming/ALIKED) are kept.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F

SAMPLES = 16
"""Points from which a descriptor is made."""
Weights = dict[str, torch.Tensor]


class _Weighted(nn.Module):
    """A module that finds its weights by their published names."""

    def __init__(self, weights: Weights) -> None:
        super().__init__()
        self.names = {name: name.replace(".", "_") for name in weights}
        for name, tensor in weights.items():
            self.register_buffer(self.names[name], tensor)

    def weight(self, name: str) -> torch.Tensor | None:
        """The weight of this name; None if there is none, as for a missing bias."""
        return getattr(self, self.names[name]) if name in self.names else None

    def convolve(self, name: str, x: torch.Tensor, padding: int = 1) -> torch.Tensor:
        """Convolution with the weights of this name."""
        return F.conv2d(x, self.weight(f"{name}.weight"), self.weight(f"{name}.bias"), padding=padding)


class DenseAliked(_Weighted):
    """Feature map and score map of an image."""

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Maps of an image.

        Args:
            image: (1, 3, h, w) RGB from 0 to 1; h and w are multiples of 32.

        Returns:
            Unit vectors (1, 128, h, w), and scores (1, 1, h, w) from 0 to 1.
        """
        x1 = F.selu(self._normalized("block1.bn1", self.convolve("block1.conv1", image)))
        x1 = F.selu(self._normalized("block1.bn2", self.convolve("block1.conv2", x1)))
        x2 = self._residual("block2", F.avg_pool2d(x1, 2), self.convolve)
        x3 = self._residual("block3", F.avg_pool2d(x2, 4), self._deformed)
        x4 = self._residual("block4", F.avg_pool2d(x3, 4), self._deformed)
        parts = [F.selu(self.convolve(f"conv{k + 1}", x, 0)) for k, x in enumerate((x1, x2, x3, x4))]
        for k, factor in ((1, 2), (2, 8), (3, 32)):
            parts[k] = F.interpolate(parts[k], scale_factor=factor, mode="bilinear", align_corners=True)
        features = torch.cat(parts, dim=1)
        y = F.selu(self.convolve("score_head.0", features, 0))
        for layer in ("score_head.2", "score_head.4"):
            y = F.selu(self.convolve(layer, y))
        return F.normalize(features, dim=1), torch.sigmoid(self.convolve("score_head.6", y))

    def _normalized(self, name: str, x: torch.Tensor) -> torch.Tensor:
        """Batch normalization with the stored statistics."""
        parts = [self.weight(f"{name}.{part}") for part in ("running_mean", "running_var", "weight", "bias")]
        return F.batch_norm(x, *parts)

    def _residual(self, name: str, x: torch.Tensor, layer: object) -> torch.Tensor:
        y = F.selu(self._normalized(f"{name}.bn1", layer(f"{name}.conv1", x)))
        y = self._normalized(f"{name}.bn2", layer(f"{name}.conv2", y))
        return F.selu(y + self.convolve(f"{name}.downsample", x, 0))

    def _deformed(self, name: str, x: torch.Tensor) -> torch.Tensor:
        """Deformable 3 x 3 convolution (Dai et al., ICCV 2017)."""
        rows, columns = x.shape[2:]
        limit = torch.sym_max(rows, columns) / 4.0
        offset = torch.clamp(self.convolve(f"{name}.offset_conv", x), -1.0 * limit, 1.0 * limit)
        return deformable_convolution(x, offset, self.weight(f"{name}.regular_conv.weight"))


def deformable_convolution(x: torch.Tensor, offset: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """(1, o, h, w) from x (1, c, h, w), offsets (1, 18, h, w) as y and x of each element, and weights (o, c, 3, 3)."""
    rows, columns = x.shape[2:]
    y0 = torch.arange(rows, dtype=x.dtype)[:, None]
    x0 = torch.arange(columns, dtype=x.dtype)[None, :]
    out = torch.zeros(())
    for k in range(9):
        at_y = y0 + (k // 3 - 1) + offset[0, 2 * k]
        at_x = x0 + (k % 3 - 1) + offset[0, 2 * k + 1]
        grid = torch.stack([(2 * at_x + 1) / columns - 1, (2 * at_y + 1) / rows - 1], dim=-1)
        sampled = F.grid_sample(x, grid[None], mode="bilinear", padding_mode="zeros", align_corners=False)
        out = out + F.conv2d(sampled, weight[:, :, k // 3, k % 3, None, None])
    return out


class AlikedDescriptors(_Weighted):
    """Descriptors at keypoints, from 16 points around each that depend on the image (sparse deformable head)."""

    def forward(self, features: torch.Tensor, keypoints: torch.Tensor) -> torch.Tensor:
        """(n, 128) unit vectors.

        Args:
            features: (1, 128, h, w) of `DenseAliked`, without the padding of the image.
            keypoints: (n, 2) as x and y; (0, 0) is the center of the first element.
        """
        rows, columns = features.shape[2:]
        # The published code's patch starts one pixel before the keypoint and ends one pixel before the border.
        corner_x = keypoints[:, 0].long().sub(1).clamp(min=0)
        corner_y = keypoints[:, 1].long().sub(1).clamp(min=0)
        corner_x = torch.minimum(corner_x, torch.ones_like(corner_x) * (columns - 4))
        corner_y = torch.minimum(corner_y, torch.ones_like(corner_y) * (rows - 4))
        flat = features[0].flatten(1)
        patch = torch.stack(
            [flat.index_select(1, (corner_y + k // 3) * columns + corner_x + k % 3) for k in range(9)],
            dim=-1,
        )
        patch = patch.permute(1, 0, 2).unflatten(2, (3, 3))
        offset = self.convolve(
            "desc_head.offset_conv.2", F.selu(self.convolve("desc_head.offset_conv.0", patch, 0)), 0
        )
        limit = torch.sym_max(rows, columns) / 4.0
        offset = torch.clamp(offset, -1.0 * limit, 1.0 * limit)[:, :, 0, 0]
        at = keypoints[:, None] + offset.unflatten(1, (2, SAMPLES)).transpose(1, 2)
        grid = torch.stack([2 * at[..., 0] / (columns - 1) - 1, 2 * at[..., 1] / (rows - 1) - 1], dim=-1)
        sampled = F.grid_sample(features, grid[None], mode="bilinear", align_corners=True)
        sampled = F.selu(self.convolve("desc_head.sf_conv", sampled, 0))[0]
        descriptors = torch.einsum("cnp,pcd->nd", sampled, self.weight("desc_head.agg_weights"))
        return F.normalize(descriptors, dim=1)
