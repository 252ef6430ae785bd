"""SPZ files of other programs, every byte of which is damaged in turn: a clear error or sound Gaussians."""

import gzip
import os
import struct
from pathlib import Path

import gsply
import numpy as np
import pytest

from epipole.errors import EpipoleError
from epipole.io.gaussian_files import read_gaussians

FAULTS = Path(os.environ.get("EPIPOLE_DATA", Path(__file__).parents[3] / "shared" / "data")) / "faults"


def version_2(path):
    numbers = np.random.default_rng(0).integers(0, 256, 3 * 19, np.uint8)
    head = struct.pack("<IIIBBBB", 0x5053474E, 2, 3, 0, 12, 0, 0)
    path.write_bytes(gzip.compress(head + numbers.tobytes(), mtime=0))


def version_4(path):
    rng = np.random.default_rng(0)
    sizes = {"means": (3, 3), "scales": (3, 3), "quats": (3, 4), "opacities": (3,), "sh0": (3, 3)}
    arrays = {name: rng.normal(size=size).astype(np.float32) for name, size in sizes.items()}
    gsply.write_spz(path, gsply.GSData.from_arrays(**arrays), version=4)


def copied(name):
    return lambda path: path.write_bytes((FAULTS / name).read_bytes())


MADE = {"version 2": version_2, "version 4": version_4}
FOUND = {
    name: copied(name)
    for name in ("minimal-v2.spz", "minimal-v3.spz", "minimal-v4.spz")
    if (FAULTS / name).is_file()
}


@pytest.mark.parametrize("what", [*MADE, *FOUND])
def test_every_byte_may_be_wrong(what, tmp_path):
    path = tmp_path / "a.spz"
    (MADE | FOUND)[what](path)
    whole = path.read_bytes()
    assert len(read_gaussians(path)) > 0
    refused = 0
    for at in range(len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        try:
            assert len(read_gaussians(path)) > 0
        except EpipoleError as error:
            refused += 1
            assert str(path) in str(error)
    assert refused > 20
