"""SOG: files written by hand from the specification's equations, there and back within the rounding, damaged files."""

import io
import json
import math
import zipfile
from dataclasses import fields, replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree
from test_io_gaussian_files import CAMERA, cloud_of
from test_io_gaussian_ply import PARTS

from epipole import _parallel
from epipole.errors import ConfigError, FileFormatError, ShapeError
from epipole.fields.splat.rasterizer import render
from epipole.io.gaussians._sog_palettes import codebook_of, codes_of, palette_of
from epipole.io.gaussians.files import is_sog, read_gaussians, write_gaussians
from epipole.io.gaussians.sog import read_sog, write_sog
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.synthetic import look_at

COUNT, WIDTH, HEIGHT = 5, 3, 2
"""The last pixel belongs to no Gaussian."""
LABELS = (0, 63, 64, 69, 1)
CODEBOOKS = {"scales": (-6.0, 0.02), "sh0": (-1.0, 0.01), "shN": (-0.5, 0.004)}
RANGES = {
    "scales": ([-6, -5, -4], [-1, -2, -3]),
    "sh0": ([-1, -2, -3, -5], [1, 2, 3, 5]),
    "shN": (-0.5, 0.25),
}


def image(pixels, size=(WIDTH, HEIGHT), kind="WEBP"):
    """Of rows of red, green, blue and alpha."""
    image = Image.new("RGBA", size)
    image.putdata([tuple(pixel) for pixel in pixels])
    data = io.BytesIO()
    image.save(data, kind, **({"lossless": True, "exact": True} if kind == "WEBP" else {}))
    return data.getvalue()


def by_hand(version=2, kind="WEBP"):
    """(meta, images by name, codes by name) of a file of five Gaussians with harmonics of degree 1."""
    rng = np.random.default_rng(3)
    codes = {name: rng.integers(0, 256, (6, 4)) for name in ("low", "up", "scales", "quats", "sh0")}
    codes["quats"][:, :3] = rng.integers(60, 200, (6, 3))
    codes["quats"][:, 3] = 252, 253, 254, 255, 252, 0
    codes["sh0"][:2, 3] = 0, 255
    codes["palette"] = rng.integers(0, 256, (2 * 64 * 3, 4))
    codes["labels"] = np.array([[label % 256, label // 256, 7, 9] for label in (*LABELS, 9999)]) % 256
    sizes = {"palette": (64 * 3, 2)}
    images = {name: image(rows, sizes.get(name, (WIDTH, HEIGHT)), kind) for name, rows in codes.items()}
    meta = {
        "means": {"mins": [-2, -1, 0.5], "maxs": [1, 2, 3], "files": ["low", "up"]},
        "scales": {"files": ["scales"]},
        "quats": {"files": ["quats"]},
        "sh0": {"files": ["sh0"]},
        "shN": {"files": ["palette", "labels"]},
    }
    if version == 2:
        meta.update(version=2, count=COUNT, asset={"generator": "by hand"})
        meta["shN"].update(count=70, bands=1)
        for name, (first, step) in CODEBOOKS.items():
            meta[name]["codebook"] = [first + step * k for k in range(256)]
    else:
        meta["means"]["shape"] = [COUNT, 3]
        for name, (low, high) in RANGES.items():
            meta[name].update(mins=low, maxs=high)
    return meta, images, codes


def put(path, meta, images):
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in images.items():
            archive.writestr(name, data)
        if meta is not None:
            archive.writestr("meta.json", meta if isinstance(meta, str | bytes) else json.dumps(meta))
    return path


def meant(version, part, code, channel):
    if version == 2:
        first, step = CODEBOOKS[part]
        return first + step * code
    low, high = (ends if part == "shN" else ends[channel] for ends in RANGES[part])
    return low + (high - low) * code / 255


def check_by_hand(cloud, codes, version):
    """Number by number, as the specification says it."""
    meta = by_hand(version)[0]
    assert len(cloud) == COUNT and cloud.sh_degree == 1
    for i in range(COUNT):
        for k in range(3):
            q = codes["up"][i, k] << 8 | codes["low"][i, k]
            low, high = meta["means"]["mins"][k], meta["means"]["maxs"][k]
            n = low + (high - low) * q / 65535
            position = math.copysign(math.exp(abs(n)) - 1, n)
            assert cloud.means_in_world[i, k] == pytest.approx(position, rel=1e-6)
            assert cloud.log_scales[i, k] == pytest.approx(meant(version, "scales", codes["scales"][i, k], k))
            assert cloud.sh[i, 0, k] == pytest.approx(meant(version, "sh0", codes["sh0"][i, k], k), abs=1e-6)
            for j in range(3):
                at = LABELS[i] // 64 * 192 + LABELS[i] % 64 * 3 + j
                wanted = meant(version, "shN", codes["palette"][at, k], k)
                assert cloud.sh[i, 1 + j, k] == pytest.approx(wanted, abs=1e-6)
        alpha = codes["sh0"][i, 3]
        if version == 1:
            assert cloud.opacity_logits[i] == pytest.approx(meant(1, "sh0", alpha, 3), rel=1e-5)
        else:
            assert 1 / (1 + math.exp(-cloud.opacity_logits[i])) == pytest.approx(alpha / 255, abs=1e-6)
        kept = [(c / 255 - 0.5) * 2 / math.sqrt(2) for c in codes["quats"][i, :3]]
        kept.insert(codes["quats"][i, 3] - 252, math.sqrt(1 - sum(c * c for c in kept)))
        assert cloud.quats_wxyz[i] == pytest.approx(kept, abs=1e-6)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("kind", ["WEBP", "PNG"])
def test_a_file_written_by_hand(tmp_path, version, kind):
    meta, images, codes = by_hand(version, kind)
    check_by_hand(read_gaussians(put(tmp_path / "a.sog", meta, images)), codes, version)
    for name, data in images.items():
        (tmp_path / name).write_bytes(data)
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    check_by_hand(read_gaussians(tmp_path / "meta.json"), codes, version)


def test_a_first_number_of_a_codebook_that_was_left_out(tmp_path):
    meta, images, codes = by_hand()
    meta["scales"]["codebook"][0] = None
    codes["scales"][:] = 0
    images["scales"] = image(codes["scales"])
    found = read_sog(put(tmp_path / "a.sog", meta, images))
    first, step = CODEBOOKS["scales"]
    assert found.log_scales == pytest.approx(np.full((COUNT, 3), first + step - step * 254 / 255), abs=1e-5)


def there_and_back(path, cloud):
    """What is read, in the order of what was written."""
    write_sog(path, cloud)
    found = read_sog(path)
    position = cKDTree(found.means_in_world).query(cloud.means_in_world)[1]
    assert sorted(position) == list(range(len(cloud)))
    return found.rows(position)


def test_numbers_come_back_within_their_rounding(rng, tmp_path):
    cloud = cloud_of(rng, 900)
    found = there_and_back(tmp_path / "a.sog", cloud)
    logs = np.log1p(np.abs(cloud.means_in_world))
    half_step = (2 * logs.max() / 65535) / 2
    assert np.abs(np.log1p(np.abs(found.means_in_world)) - logs).max() < 1.01 * half_step + 1e-7
    opacity, was = (1 / (1 + np.exp(-c.opacity_logits)) for c in (found, cloud))
    assert np.abs(opacity - was).max() < 0.5 / 255 + 1e-6
    # Three parts within half a step of sqrt(2) / 255, and the fourth, at least 1/2, follows from them.
    unit, other = (c.quats_wxyz / np.linalg.norm(c.quats_wxyz, axis=1, keepdims=True) for c in (found, cloud))
    assert np.abs((unit * other).sum(axis=1)).min() > 1 - 5e-5
    for part, bound in (("log_scales", 1 / 256), ("sh", 0.02)):
        change = getattr(found, part) - getattr(cloud, part)
        assert np.sqrt((change**2).mean()) < bound / 2 and len(np.unique(getattr(found, part)[:, 0])) <= 256


def test_what_was_read_is_written_unchanged(rng, tmp_path):
    write_sog(tmp_path / "a.sog", cloud_of(rng, 500, 9))
    first = read_sog(tmp_path / "a.sog")
    write_sog(tmp_path / "b.sog", first)
    write_sog(tmp_path / "c.sog", first)
    assert (tmp_path / "b.sog").read_bytes() == (tmp_path / "c.sog").read_bytes()
    second = read_sog(tmp_path / "b.sog")
    assert first.means_in_world == pytest.approx(second.means_in_world, abs=1e-4)
    for part in ("log_scales", "opacity_logits", "sh"):
        assert np.array_equal(getattr(first, part), getattr(second, part))


def test_a_drawing_stays_what_it_was(rng, tmp_path):
    """In a trained scene harmonics go with the place; without such order, as here in a part of them, a palette is coarse."""
    cloud = cloud_of(rng, 4000)
    cloud.sh[:, 1:] *= 0.1
    cloud.sh[:, 1:] += 0.2 * np.sin(3 * cloud.means_in_world @ rng.normal(size=(3, 45))).reshape(-1, 15, 3)
    flat = GaussianCloud(*(getattr(cloud, part) for part in PARTS[:4]), np.ascontiguousarray(cloud.sh[:, :1]))
    for one, least_db in ((flat, 65), (cloud, 34)):
        write_gaussians(tmp_path / "a.sog", one)
        found = read_gaussians(tmp_path / "a.sog")
        for position in (look_at((0, -3, 1), (0, 0, 0)), look_at((2.5, 1, -1), (0, 0, 0))):
            rendered, again = (render(c, CAMERA, position).color for c in (one, found))
            assert -10 * np.log10(((rendered - again) ** 2).mean()) > least_db


def test_what_lies_in_the_file(rng, tmp_path):
    cloud = cloud_of(rng, 70, 4)
    cloud.opacity_logits[:9] = -30
    write_sog(tmp_path / "a.sog", cloud)
    assert is_sog(tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert all(member.compress_type == zipfile.ZIP_STORED for member in archive.infolist())
        meta = json.loads(archive.read("meta.json"))
        parts = [name for part in ("means", "scales", "quats", "sh0", "shN") for name in meta[part]["files"]]
        images = {name: np.asarray(Image.open(archive.open(name)).convert("RGBA")) for name in parts}
    assert sorted(parts) == sorted(
        f"{name}.webp"
        for name in ("means_l", "means_u", "scales", "quats", "sh0", "shN_centroids", "shN_labels")
    )
    assert meta["version"] == 2 and meta["count"] == 70 and meta["shN"]["bands"] == 1
    assert {image.shape for name, image in images.items() if "centr" not in name} == {(8, 12, 4)}
    assert images["shN_centroids.webp"].shape == (2, 64 * 3, 4)
    assert images["quats.webp"].reshape(-1, 4)[:70, 3].min() >= 252
    clear = images["sh0.webp"].reshape(-1, 4)[:70]
    # Lossless WebP that is not exact would have made these black.
    assert (clear[:, 3] == 0).sum() == 9 and clear[clear[:, 3] == 0, :3].any(axis=1).all()


def test_only_finite_gaussians_are_written(rng, tmp_path):
    cloud = cloud_of(rng, 20, 4)
    cloud.means_in_world[3, 1] = np.nan
    cloud.sh[5, 2, 0] = np.inf
    cloud.means_in_world[7] = 3e38
    cloud.sh[8, 1:] = -3e38
    cloud.opacity_logits[9:11] = 3e38, -3e38
    write_sog(tmp_path / "a.sog", cloud)
    assert len(read_sog(tmp_path / "a.sog")) == 18
    per_gaussian = [field.name for field in fields(cloud) if field.name != "origin_in_world"]
    nothing = replace(cloud, **{name: np.full_like(getattr(cloud, name), np.nan) for name in per_gaussian})
    with pytest.raises(ShapeError, match="origin_in_world must be finite"):
        replace(cloud, origin_in_world=np.full(3, np.inf))
    for empty in (nothing, nothing.rows(np.zeros(0, np.int64))):
        with pytest.raises(ConfigError, match="nothing to write"):
            write_sog(tmp_path / "b.sog", empty)
    assert not (tmp_path / "b.sog").exists()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_very_few_and_all_the_same(rng, tmp_path, count):
    one = cloud_of(rng, 1)
    write_sog(tmp_path / "a.sog", one.rows(np.zeros(count, np.int64)))
    found = read_sog(tmp_path / "a.sog")
    assert len(found) == count and found.means_in_world == pytest.approx(
        np.repeat(one.means_in_world, count, 0), 1e-5
    )


def test_any_number_of_threads_writes_the_same(rng, tmp_path):
    cloud = cloud_of(rng, 9000, 4)
    for name, threads in (("a", 1), ("b", 3)):
        _parallel.set_num_threads(threads)
        try:
            write_sog(tmp_path / f"{name}.sog", cloud)
        finally:
            _parallel.set_num_threads(None)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_codebooks_and_palettes(rng):
    few = rng.permutation(np.repeat(np.arange(256, dtype=np.float32) ** 3, 3))
    assert np.array_equal(codebook_of(few)[codes_of(few, codebook_of(few))], few)
    # Values that differ by the last digit only, and none twice.
    near = np.nextafter(np.float32(1), np.float32(2)) ** np.arange(400, dtype=np.float32)
    assert np.abs(codebook_of(near)[codes_of(near, codebook_of(near))] - near).max() < 1e-6
    values = rng.normal(size=50_000).astype(np.float32)
    error = codebook_of(values)[codes_of(values, codebook_of(values))] - values
    # The best of 256 (Panter and Dite): sqrt(pi sqrt(3) / 2) / 256.
    assert np.sqrt((error**2).mean()) < 1.05 * math.sqrt(math.pi * math.sqrt(3) / 2) / 256
    centers = rng.normal(size=(60, 9)).astype(np.float32)
    rows = np.repeat(centers, 50, 0) + 1e-4 * rng.normal(size=(3000, 9)).astype(np.float32)
    palette, labels = palette_of(rows, np.ones(3000, np.float32), 300)
    assert len(palette) <= 300 and np.abs(palette[labels] - rows).max() < 1e-3
    palette, labels = palette_of(np.ones((3000, 9), np.float32), np.ones(3000, np.float32), 300)
    assert np.array_equal(palette[labels], np.ones((3000, 9)))


def changed(*keys, value):
    def change(meta, images):
        inside = meta
        for key in keys[:-1]:
            inside = inside[key]
        inside[keys[-1]] = value

    return change


def without(*keys):
    def change(meta, images):
        inside = meta
        for key in keys[:-1]:
            inside = inside[key]
        del inside[keys[-1]]

    return change


def other_picture(name, data):
    return lambda meta, images: images.update({name: data})


def webp(mode, size):
    data = io.BytesIO()
    Image.new(mode, size).save(data, "WEBP", lossless=True)
    return data.getvalue()


def gray():
    data = io.BytesIO()
    Image.new("L", (3, 2)).save(data, "PNG")
    return data.getvalue()


BAD = {
    "another version": (changed("version", value=3), "unsupported SOG version 3"),
    "no version": (changed("version", value=[]), "unsupported SOG version"),
    "no means": (without("means"), "images of means"),
    "means are words": (changed("means", value="a"), "images of means"),
    "one image of two": (changed("means", "files", value=["low"]), "images of means"),
    "a name is a number": (changed("quats", "files", value=[3]), "a name must be text"),
    "no such image": (changed("quats", "files", value=["../../etc/passwd"]), "no item named"),
    "no count": (without("count"), "no number of Gaussians"),
    "half a Gaussian": (changed("count", value=2.5), "no number of Gaussians"),
    "none": (changed("count", value=0), "no number of Gaussians"),
    "very many": (changed("count", value=10**12), "1000000000000 Gaussians cannot fit"),
    "more than the images hold": (changed("count", value=7), "has 6 pixels for 7"),
    "no range": (without("means", "mins"), "mins is missing"),
    "a range of two": (changed("means", "maxs", value=[1, 2]), "maxs is not 3 numbers"),
    "no codebook": (without("sh0", "codebook"), "codebook numbers of sh0"),
    "a short codebook": (changed("scales", "codebook", value=[0.0] * 255), "codebook numbers of scales"),
    "words in a codebook": (changed("scales", "codebook", value=["a"] * 256), "codebook of scales"),
    "a null in a codebook": (changed("scales", "codebook", value=[0.0, None] * 128), "codebook of scales"),
    "a label too large": (changed("shN", "count", value=69), "points to row 69 of a palette of 69"),
    "an empty palette": (changed("shN", "count", value=0), "palette size"),
    "other bands": (changed("shN", "bands", value=2), "those of 2 bands"),
    "a palette of no width": (other_picture("palette", webp("RGB", (100, 2))), "100 x 2"),
    "a palette too high": (other_picture("palette", webp("RGB", (192, 1025))), "192 x 1025"),
    "an image too large": (other_picture("scales", webp("RGB", (2000, 2000))), "too large: 2000 x 2000"),
    "a rotation without its largest": (other_picture("quats", webp("RGBA", (3, 2))), "the alpha 0"),
    "no image": (other_picture("sh0", b"nothing"), "not a WebP or PNG"),
    "a cut image": (other_picture("sh0", webp("RGB", (3, 2))[:-9]), "'sh0' is damaged"),
    "an empty image": (other_picture("sh0", b""), "not a WebP or PNG"),
    "a gray image": (other_picture("sh0", gray()), "three 8-bit colors"),
    "nothing is finite": (changed("means", "maxs", value=[1e300] * 3), "none of its 5 Gaussians is finite"),
}


@pytest.mark.parametrize("what", BAD)
def test_damaged_files_are_told(tmp_path, what):
    change, said = BAD[what]
    meta, images, _ = by_hand()
    change(meta, images)
    with pytest.raises(FileFormatError, match=said):
        read_sog(put(tmp_path / "a.sog", meta, images))


def test_damaged_zips_and_texts_are_told(tmp_path):
    meta, images, _ = by_hand()
    whole = put(tmp_path / "a.sog", meta, images).read_bytes()
    for data in (b"", b"PK", whole[:-30], whole[: len(whole) // 2], whole[: len(whole) // 2] + bytes(99)):
        (tmp_path / "a.sog").write_bytes(data)
        with pytest.raises(FileFormatError, match="not a SOG file, or damaged"):
            read_sog(tmp_path / "a.sog")
        assert not is_sog(tmp_path / "a.sog")
    for text, said in (
        ("{", "not JSON"),
        ("[1]", "not a JSON object"),
        (b"\xff\xfe", "not UTF-8"),
        (None, "no item"),
    ):
        with pytest.raises(FileFormatError, match=said):
            read_sog(put(tmp_path / "b.sog", text, images))
    with pytest.raises(FileFormatError, match="NaN is not a finite number"):
        read_sog(put(tmp_path / "b.sog", json.dumps({**meta, "count": math.nan}), images))
    with pytest.raises(FileFormatError, match="it does not exist"):
        read_sog(tmp_path / "c.sog")


def test_zips_that_unpack_to_much(tmp_path):
    meta, images, _ = by_hand()
    for name, text in (("scales", json.dumps(meta)), (None, " " * (5 << 20))):
        with zipfile.ZipFile(tmp_path / "a.sog", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("meta.json", text)
            for other, data in images.items():
                archive.writestr(other, bytes(1 << 24) if other == name else data)
        with pytest.raises(FileFormatError, match="unpacks to more than"):
            read_sog(tmp_path / "a.sog")


def test_a_name_in_a_folder_stays_inside(tmp_path):
    meta, images, _ = by_hand()
    (tmp_path / "scales").write_bytes(images["scales"])
    (tmp_path / "in").mkdir()
    for name, data in images.items():
        (tmp_path / "in" / name).write_bytes(data)
    for name in ("../scales", str(tmp_path / "scales")):
        meta["scales"]["files"] = [name]
        (tmp_path / "in" / "meta.json").write_text(json.dumps(meta))
        with pytest.raises(FileFormatError, match="does not name a file inside"):
            read_sog(tmp_path / "in" / "meta.json")
