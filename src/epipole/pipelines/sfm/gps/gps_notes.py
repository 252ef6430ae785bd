"""What is said about GPS: why it does not make a model metric, and which positions contradict it."""

from __future__ import annotations

import numpy as np

from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.gps.alignment import MIN_POSITIONS, GpsAlignment, evidence_of, is_wide_enough
from epipole.pipelines.sfm.gps.evidence import meters_in_words
from epipole.pipelines.sfm.mapping_stage import GPS_OUTLIER_SIGMAS, VAGUE_UP_RAD, Mapped
from epipole.pipelines.sfm.photographs import ImageSet
from epipole.pipelines.sfm.up_direction import up_directions
from epipole.scene.georeference import gps_to_enu

NUM_NAMED = 3


def gps_notes(images: ImageSet, mapped: Mapped, config: MapperConfig) -> list[str]:
    """Notes on GPS: why it did not make the largest model metric, or which positions contradict it."""
    has_gps = np.isfinite(images.lat_lon_alt[:, :2]).all(axis=1)
    is_posed = bool(mapped.pose_fits) and mapped.pose_fits[0] is not None
    if not (config.use_gps and mapped.models and has_gps.any()):
        return []
    if is_posed:
        return ["GPS is not used: the known poses determine the coordinates"]
    model, gps = mapped.models[0], mapped.gps[0]
    registered = model.is_registered()
    if gps is not None:
        return _notes_on_positions(images, gps, config)
    unknown = "the scale is unknown" if mapped.scale is None else "GPS is not used"
    fixes = gps_to_enu(images.lat_lon_alt[has_gps & registered])
    if len(fixes) < MIN_POSITIONS:
        verb = "carries" if len(fixes) == 1 else "carry"
        counts = f"{len(fixes) or 'none'} of the model's images {verb} GPS"
        return [f"{unknown}: {counts}, but at least {MIN_POSITIONS} are needed for meters"]
    reach_m = GPS_OUTLIER_SIGMAS * config.gps_sigma_m
    if not is_wide_enough(fixes, reach_m):
        extent_m = float(np.linalg.norm(np.ptp(fixes[:, :2], axis=0)))
        return [
            f"{unknown}: the GPS positions lie within {meters_in_words(extent_m)}, "
            f"but may be off by {meters_in_words(reach_m)}"
        ]
    found = evidence_of(
        model.camera_centers_in_world(),
        up_directions(model.cams_from_world()[registered], images.up_in_cams[registered]),
        gps_to_enu(images.lat_lon_alt),
        config.seed,
    )
    return [f"{unknown}: the GPS positions do not fit the model: {found.in_words()}"]


def _notes_on_positions(images: ImageSet, gps: GpsAlignment, config: MapperConfig) -> list[str]:
    """Images that are far from their GPS position, and a warning if the up direction is assumed."""
    out = []
    limit_m = max(GPS_OUTLIER_SIGMAS * config.gps_sigma_m, GPS_OUTLIER_SIGMAS * gps.median_m)
    far = np.flatnonzero(gps.residuals_m > limit_m)
    if len(far):
        far = far[np.argsort(-gps.residuals_m[far])]
        named = ", ".join(
            f"{images.names[i]} by {_distance_in_words(gps.residuals_m[i])}" for i in far[:NUM_NAMED]
        )
        more = f" and {len(far) - NUM_NAMED} more" if len(far) > NUM_NAMED else ""
        out.append(f"GPS positions that contradict the model are not used: {named}{more}")
    if not np.isfinite(images.lat_lon_alt[:, 2]).any():
        out.append(
            "the GPS positions have no altitude: heights are relative to an origin at 0 m, not above the ellipsoid or the sea (control"
            " points give them: epipole georeference --gcp)"
        )
    if gps.up_sigma_rad > VAGUE_UP_RAD:
        out.append(
            "the GPS positions lie nearly on a line and do not determine the up direction, "
            "which is assumed from the orientation of the cameras"
        )
    return out


def _distance_in_words(distance_m: float) -> str:
    return f"{distance_m / 1000.0:.0f} km" if distance_m >= 10_000.0 else meters_in_words(distance_m)
