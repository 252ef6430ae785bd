"""One model through every format."""

from pathlib import Path

import numpy as np
import pytest
from io_models import mappable_model

from epipole.errors import ConfigError, FileFormatError
from epipole.io import convert_model, read_colmap_model, read_points_ply, read_transforms, write_colmap_model


def test_every_format(tmp_path: Path) -> None:
    model = mappable_model()
    expected = model.cams_from_world().as_matrix()
    write_colmap_model(model, tmp_path / "bin")
    assert convert_model(tmp_path / "bin", tmp_path / "txt", "txt") == tmp_path / "txt"
    back = convert_model(tmp_path / "txt", tmp_path / "back", "bin")
    for name in ("cameras", "rigs", "frames", "images", "points3D"):
        assert (tmp_path / "txt" / f"{name}.txt").is_file()
    np.testing.assert_allclose(read_colmap_model(back).cams_from_world().as_matrix(), expected, atol=1e-12)
    (tmp_path / "out").mkdir()
    written = [
        convert_model(tmp_path / "bin", tmp_path / "out", name) for name in ("ply", "transforms", "bundler")
    ]
    assert [path.name for path in written] == ["scene.ply", "transforms.json", "bundle.out"]
    assert len(read_points_ply(written[0])) == len(model.points) + 5 * len(model.images)
    np.testing.assert_allclose(
        read_transforms(written[1]).cams_from_world().as_matrix(), expected, atol=1e-12
    )
    assert written[2].read_text().startswith("# Bundle file v0.3\n6 200\n")
    named = convert_model(written[1], tmp_path / "deep" / "my.ply", "ply")
    assert named == tmp_path / "deep" / "my.ply" and named.is_file()


def test_misuse_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="one of txt, bin, ply, transforms, bundler"):
        convert_model(tmp_path, tmp_path / "out", "obj")
    with pytest.raises(FileFormatError, match="no such folder"):
        convert_model(tmp_path / "nothing", tmp_path / "out", "ply")
    with pytest.raises(FileFormatError, match="no COLMAP model here"):
        convert_model(tmp_path, tmp_path / "out", "ply")
    assert not (tmp_path / "out").exists()
