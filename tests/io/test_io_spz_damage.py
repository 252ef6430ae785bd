"""SPZ files of other programs, every byte of which is damaged in turn: a clear error or sound Gaussians."""

import os
from pathlib import Path

import pytest
from spz_writing import write_packed_whole, write_streams

from epipole.errors import EpipoleError
from epipole.io.gaussians.files import read_gaussians

FAULTS = Path(os.environ.get("EPIPOLE_DATA", Path(__file__).parents[3] / "shared" / "data")) / "faults"


def copied(name):
    return lambda path: path.write_bytes((FAULTS / name).read_bytes())


MADE = {
    "version 2": lambda path: write_packed_whole(path, 2, 3, 0),
    "version 4": lambda path: write_streams(path, 3, 0),
}
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
