"""Trajectory of a map: frames are stored relative to their keyframe, so later optimization moves them too."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from epipole.geometry import Rigid3
from epipole.pipelines.slam.map.covariance import with_map_error
from epipole.pipelines.slam.map.slam_map import Keyframe
from epipole.scene import Trajectory

BLOCK = 512
"""Frames per array. Full arrays are replaced, never written to."""
_TIME, KEYFRAME, _UNIT = 0, 1, 2
_ROTATION, _TRANSLATION, _COVARIANCE = slice(3, 12), slice(12, 15), slice(15, 51)
_COLUMNS = 51
_NONE = -1.0


class Path:
    """Poses of frames, 408 bytes each.

    A row has the frame's time, the index of its keyframe, that keyframe's unit at the time, cam_from_keyframe and its covariance.
    """

    def __init__(self, first: int = 0) -> None:
        self.first = first
        self._keyframes: list[Keyframe | None] = []
        self._full: list[np.ndarray] = []
        self._open = _empty()

    def add(
        self, number: int, timestamp_s: float, keyframe: Keyframe, position: Rigid3, covariance: np.ndarray
    ) -> None:
        """Store a frame's cam_from_world relative to a keyframe."""
        relative = position @ keyframe.cam_from_world.inverse()
        row = np.empty(_COLUMNS)
        row[_TIME], row[KEYFRAME], row[_UNIT] = timestamp_s, self._number_of(keyframe), keyframe.unit
        row[_ROTATION], row[_TRANSLATION] = relative.rotation.ravel(), relative.translation
        row[_COVARIANCE] = covariance.ravel()
        block, position_in_block = divmod(number - self.first, BLOCK)
        while block > len(self._full):
            self._full.append(self._open)
            self._open = _empty()
        if block < len(self._full):
            self._full[block] = self._full[block].copy()
            self._full[block][position_in_block] = row
        else:
            self._open[position_in_block] = row

    def stored(self, number: int) -> tuple[Keyframe, Rigid3, np.ndarray] | None:
        """A frame's keyframe, cam_from_keyframe and its covariance, in the present unit; None for a frame without a pose."""
        block, position_in_block = divmod(number - self.first, BLOCK)
        if not 0 <= block <= len(self._full):
            return None
        row = (self._full[block] if block < len(self._full) else self._open)[position_in_block]
        keyframe = self._keyframes[int(row[KEYFRAME])] if row[KEYFRAME] >= 0 else None
        if keyframe is None:
            return None
        grown = keyframe.unit / row[_UNIT]
        relative = Rigid3(row[_ROTATION].reshape(3, 3).copy(), row[_TRANSLATION] * grown)
        return keyframe, relative, _scaled(row[_COVARIANCE].reshape(1, 6, 6), np.array([grown]))[0]

    def retell(self, gone: Keyframe, heir: Keyframe) -> None:
        """Store the frames of a removed keyframe relative to another one."""
        old = next((k for k, one in enumerate(self._keyframes) if one is gone), None)
        if old is None:
            return
        new = self._number_of(heir)
        between = gone.cam_from_world @ heir.cam_from_world.inverse()
        for rows in self._blocks_of(old):
            mask = rows[:, KEYFRAME] == old
            own = rows[mask]
            grown = gone.unit / own[:, _UNIT]
            relative = Rigid3(
                own[:, _ROTATION].reshape(-1, 3, 3), own[:, _TRANSLATION] * grown[:, None]
            ) @ Rigid3(between.rotation[None], between.translation[None])
            covariance = _scaled(own[:, _COVARIANCE].reshape(-1, 6, 6), grown)
            own[:, KEYFRAME], own[:, _UNIT] = new, heir.unit
            own[:, _ROTATION] = relative.rotation.reshape(-1, 9)
            own[:, _TRANSLATION], own[:, _COVARIANCE] = relative.translation, covariance.reshape(-1, 36)
            rows[mask] = own
        self._keyframes[old] = None

    def clear(self, keyframes: Sequence[Keyframe]) -> None:
        """Remove the poses of the frames of these keyframes."""
        gone = {id(k) for k in keyframes}
        for number, one in enumerate(self._keyframes):
            if one is not None and id(one) in gone:
                for rows in self._blocks_of(number):
                    rows[rows[:, KEYFRAME] == number, KEYFRAME] = _NONE
                self._keyframes[number] = None

    def trajectory(self, keyframes: Sequence[Keyframe]) -> Trajectory:
        """The frames of these keyframes, with the keyframes' present poses."""
        known = {id(k) for k in keyframes}
        used = [n for n, k in enumerate(self._keyframes) if k is not None and id(k) in known]
        rows = np.concatenate([*self._full, self._open])
        rows = rows[np.isin(rows[:, KEYFRAME], used)]
        if not len(rows):
            return Trajectory(np.zeros(0), Rigid3.identity(0), np.zeros((0, 6, 6)))
        keys = [k for k in (self._keyframes[n] for n in used) if k is not None]
        which = np.searchsorted(used, rows[:, KEYFRAME])
        grown = np.array([k.unit for k in keys])[which] / rows[:, _UNIT]
        relative = Rigid3(rows[:, _ROTATION].reshape(-1, 3, 3).copy(), rows[:, _TRANSLATION] * grown[:, None])
        there = Rigid3(
            np.stack([k.cam_from_world.rotation for k in keys])[which],
            np.stack([k.cam_from_world.translation for k in keys])[which],
        )
        own = _scaled(rows[:, _COVARIANCE].reshape(-1, 6, 6), grown)
        of_map = np.stack([k.covariance for k in keys])[which]
        positions = (relative @ there).inverse()
        return Trajectory(rows[:, _TIME].copy(), positions, with_map_error(of_map, relative, own))

    def _number_of(self, keyframe: Keyframe) -> int:
        """Index in the list, to which it is appended if missing. The search starts at the newest, which are requested most."""
        for number in range(len(self._keyframes) - 1, -1, -1):
            if self._keyframes[number] is keyframe:
                return number
        self._keyframes.append(keyframe)
        return len(self._keyframes) - 1

    def _blocks_of(self, keyframe: int) -> list[np.ndarray]:
        """Writable blocks with frames of a keyframe."""
        out = []
        for n, rows in enumerate(self._full):
            if (rows[:, KEYFRAME] == keyframe).any():
                self._full[n] = rows.copy()
                out.append(self._full[n])
        return [*out, self._open]


def _empty() -> np.ndarray:
    return np.full((BLOCK, _COLUMNS), _NONE)


def _scaled(covariance: np.ndarray, grown: np.ndarray) -> np.ndarray:
    """(n, 6, 6) covariances of poses after a change of unit."""
    unit = np.repeat(np.stack([grown, np.ones(len(grown))], axis=1), 3, axis=1)
    return covariance * unit[:, :, None] * unit[:, None, :]
