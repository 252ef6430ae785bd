"""What the objects of a stored state hold, attribute by attribute: they are made without their constructors, which check nothing then.

Data classes say it in their annotations. Of other classes it stands here. Arrays of one object share the lengths of named axes.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from inspect import get_annotations
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from epipole._declared.kinds import Convert, Sizes
from epipole._declared.values import converter_of
from epipole.cameras import Camera
from epipole.errors import EpipoleError
from epipole.geometry import Rigid3
from epipole.geometry.batch import Batch
from epipole.inertial import ImuNoise, InertialAlignment, MountedImu
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.frames import Frame, MovingThing, SlamCamera
from epipole.pipelines.slam.inertial_ties import InertialTies
from epipole.pipelines.slam.local_mapping import LocalMapper
from epipole.pipelines.slam.loop_closing import LoopCloser, _Hypothesis
from epipole.pipelines.slam.map_tracking import MapTracker
from epipole.pipelines.slam.path import Path
from epipole.pipelines.slam.picture_watch import PictureWatch
from epipole.pipelines.slam.recent_motion import RecentMotion
from epipole.pipelines.slam.slam_map import Keyframe, SlamMap
from epipole.pipelines.slam.starting import OneCameraStart, WaitingFrame
from epipole.pipelines.slam.static_points import StaticPart
from epipole.pipelines.slam.tracking import SeenFrame, Tracks
from epipole.pipelines.slam.turning import Turning

_Pixels = Float64[np.ndarray, "n 2"]
_Numbers = Float64[np.ndarray, " n"]
_Rows = Int64[np.ndarray, " n"]
_Motion = Float64[np.ndarray, " 12"]
_Block = Float64[np.ndarray, "_ 51"]
ATTRIBUTES: dict[type, dict[str, Any]] = {
    InertialTies: {"imu": MountedImu, "aligned": InertialAlignment | None, "noise": ImuNoise},
    LocalMapper: {
        "map": SlamMap,
        "sensor": SlamCamera,
        "camera": Camera,
        "config": SlamConfig,
        "focal_baseline": float | None,
        "positions": dict,
        "position_sigma": float,
        "inertial": InertialTies | None,
        "_num_settled": int,
    },
    LoopCloser: {
        "camera": Camera,
        "config": SlamConfig,
        "is_metric": bool,
        "ledger": list,
        "_waiting": list[_Hypothesis],
    },
    MapTracker: {
        "map": SlamMap,
        "sensor": SlamCamera,
        "camera": Camera,
        "config": SlamConfig,
        "focal_baseline": float | None,
        "tracks": Tracks,
        "stale": Int64[np.ndarray, " s"],
        "moving": MovingThing | None,
        "static_part": StaticPart | None,
        "_num_at_start": int,
        "_place_before": Rigid3 | None,
        "waiting": list[SeenFrame],
        "_seen": SeenFrame | None,
    },
    Path: {"first": int, "_keyframes": list[Keyframe | None], "_full": list[_Block], "_open": _Block},
    PictureWatch: {"_usual": list[Float64[np.ndarray, " u"]]},
    RecentMotion: {"times": list[float], "steps": list[Rigid3], "has_dropped": bool},
    Keyframe: {
        "number": int,
        "timestamp_s": float,
        "grey": UInt8[np.ndarray, "h w"],
        "cam_from_world": Rigid3,
        "pixels": _Pixels,
        "disparity_px": _Numbers,
        "motion": _Motion,
        "shift_px": Float64[np.ndarray, "n 3"],
        "point": _Rows,
        "descriptors": UInt8[np.ndarray, "n 128"],
        "look": Float32[np.ndarray, " l"] | None,
        "unit": float,
        "ignored_mask": Bool[np.ndarray, "h w"] | None,
        "covariance": Float64[np.ndarray, "6 6"],
    },
    SlamMap: {
        "number": int,
        "keyframes": list[Keyframe],
        "_xyz": Float64[np.ndarray, "p 3"],
        "_anchor": Int64[np.ndarray, " p"],
        "_anchor_px": Float64[np.ndarray, "p 2"],
        "_num_agreed": Int64[np.ndarray, " p"],
        "num_points": int,
        "motion": _Motion,
        "recent": RecentMotion,
        "right_shift_px": float,
    },
    WaitingFrame: {"frame": Frame, "number": int, "pixels": _Pixels, "track": _Rows},
    OneCameraStart: {
        "camera": Camera,
        "config": SlamConfig,
        "tracks": Tracks,
        "_waiting": list[WaitingFrame],
        "_num_at_start": int,
    },
    Tracks: {"pixels": _Pixels, "point": _Rows, "start_px": _Pixels},
    SeenFrame: {
        "number": int,
        "timestamp_s": float,
        "pixels": _Pixels,
        "point": _Rows,
        "disparity_px": _Numbers | None,
        "motion": _Motion | None,
    },
    Turning: {
        "camera": Camera,
        "config": SlamConfig,
        "start": Rigid3,
        "keyframes": list[Keyframe],
        "_sphere": SlamMap,
        "_tracks": Tracks,
        "_cam_from_sphere": Rigid3,
        "_before": Frame,
        "_num_at_keyframe": int,
    },
}
"""Of the classes that declare nothing."""
_plans: dict[type, dict[str, Convert | None]] = {}


def problem_of_objects(made: Iterable[object]) -> str:
    """What is wrong with the attributes of objects, each by itself; empty where nothing is."""
    for one in made:
        problem = _problem_of(one)
        if problem:
            return f"{type(one).__name__}: {problem}"
    return ""


def _problem_of(one: object) -> str:
    plan, sizes = attributes_of(type(one)), Sizes()
    held = {name: getattr(one, name) for name in plan}
    try:
        for name, convert in plan.items():
            if convert is not None:
                convert(
                    held[name], name, sizes
                )  # what it returns may be laid out otherwise, and sum up to other bits
        if isinstance(one, Batch) and type(one)(**held).batch_shape() != ():
            return "it is more than one motion"
    except EpipoleError as error:
        return str(error)
    return ""


def attributes_of(kind: type) -> dict[str, Convert | None]:
    """Of a class the attributes that its objects have, and what checks each."""
    if kind not in _plans:
        declared = ATTRIBUTES.get(kind)
        if declared is None:
            names = vars(sys.modules[kind.__module__])
            declared = {
                name: eval(one, names) if isinstance(one, str) else one
                for name, one in get_annotations(kind).items()
            }
        _plans[kind] = {name: converter_of(one) for name, one in declared.items()}
    return _plans[kind]
