"""Keys of transforms.json as written by nerfstudio, instant-ngp and exporters of the same format.

Each key is used, known to have no effect, or named in a warning. Unknown keys that may change geometry are rejected.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from epipole.errors import ConfigError
from epipole.io._spherical import SPHERICAL_REFUSAL, is_spherical_word

SPLIT_KEYS = {"train": "train_filenames", "val": "val_filenames", "test": "test_filenames"}
"""nerfstudio's lists of image names by split."""

_USED_WORDS = (
    "camera_model is_fisheye w h width height image_width image_height fl_x fl_y cx cy k1 k2 k3 k4 k5 k6 p1 p2 camera_angle_x camera_angle_y x_fov y_fov "
    "frames ply_file_path file_path transform_matrix mask_path is_bad applied_transform applied_scale origin_in_world georeference "
    "train_filenames val_filenames test_filenames"
)
# Settings of trainers and viewers, and metadata about the capture, which do not affect poses and intrinsics.
_WORDS_WITHOUT_EFFECT = (
    "aabb aabb_scale render_aabb scene_box scale offset up orientation_override auto_scale_poses_override center_method "
    "auto_orient auto_scale sharpness sharpness_discard_threshold sharpen blur_score motion_blur_score colmap_im_id image_id "
    "camera_id cam_id camera_name camera_label frame_id timestamp timestamps time date fps rotation name source version "
    "generator comment bg_color white_background driver_parameters importance_sampling n_extra_learnable_dims "
    "enable_depth_loading enable_ray_loading integer_depth_scale depth_unit_scale_factor normal_mts_args from_mitsuba has_mask "
    "exposure_time iso iso_speed original_file_path original_fname camera_linear_velocity camera_angular_velocity"
)
_USED, _WITHOUT_EFFECT = frozenset(_USED_WORDS.split()), frozenset(_WORDS_WITHOUT_EFFECT.split())
# Known keys whose content is ignored.
_NOT_USED = {
    "depth_file_path": "depth maps are not used",
    "depth_path": "depth maps are not used",
    "normal_file_path": "normal maps are not used",
    "semantics_file_path": "labels are not used",
    "envmap": "the environment map is not used",
    "n_frames": "all frames are read",
    "test_frames": "only the list frames is read",
    "white_transparent": "white is not treated as transparent",
    "black_transparent": "black is not treated as transparent",
    "fix_premult": "colors are read as stored",
    "mask_color": "this color is not treated as a mask",
    "rolling_shutter_time": "each image has one pose",
    "fisheye_crop_radius": "the full image is used",
}
_GEOMETRY = re.compile(
    r"[kpsb]\d+|xi|alpha|beta|gamma\w*|omega\w*|tau\w*|skew\w*|shear\w*|ftheta\w*|from_na|crop_\w+|(\w+_)?shift_[xy]"
    r"|\w*(distort|lens|fisheye|orthogra|projection|intrinsic|camera_model|camera_type|shutter|transform|principal|pixel_aspect"
    r"|convention|coordinate)\w*",
    re.IGNORECASE,
)
# Names of the axis convention of this format.
_AXES = ("opengl", "blender", "nerf", "nerfstudio")
_MOST_NAMED = 6


def require_known_keys(values: Mapping[str, Any]) -> None:
    """Check the keys of the file, or of one of its frames.

    Raises:
        ConfigError: an unknown key may change the geometry, and its value is not zero or empty.
    """
    for key, value in values.items():
        if key in _USED or key in _WITHOUT_EFFECT or key in _NOT_USED or _says_nothing(value):
            continue
        if is_spherical_word(key):
            raise ConfigError(f"{key}: {SPHERICAL_REFUSAL}")
        if _GEOMETRY.fullmatch(key) and str(value).lower() not in _AXES:
            shown = repr(value)[:40]
            raise ConfigError(
                f"unknown key {key} = {shown}, which may change the camera or its pose (remove it if it does not)"
            )


def key_warnings(values: Mapping[str, Any], frames: Sequence[Mapping[str, Any]]) -> list[str]:
    """Warnings about ignored keys of a file that passed `require_known_keys`."""
    unused: dict[str, None] = {}
    unknown: dict[str, None] = {}
    for part in (values, *frames):
        for key, value in part.items():
            if _says_nothing(value) or (key == "n_frames" and value == len(frames)):
                continue
            if key in _NOT_USED:
                unused[key] = None
            elif key not in _USED and key not in _WITHOUT_EFFECT and not _GEOMETRY.fullmatch(key):
                unknown[str(key)] = None
    out = [f"{key} is not used ({_NOT_USED[key]})" for key in unused]
    if unknown:
        more = f" and {len(unknown) - _MOST_NAMED} more" if len(unknown) > _MOST_NAMED else ""
        named = ", ".join(key[:40] for key in list(unknown)[:_MOST_NAMED])
        out.append(f"unknown keys are ignored: {named}{more}")
    return out


def _says_nothing(value: Any) -> bool:
    if isinstance(value, list):
        return all(_says_nothing(item) for item in value)
    return (
        value is None
        or value is False
        or value in ("", {})
        or (isinstance(value, (int, float)) and value == 0)
    )
