"""Addresses on a network are no paths: refused with what to do, whichever argument or option they stand for."""

from pathlib import Path

import pytest

import epipole
from epipole.cli.main import main
from epipole.errors import ConfigError
from epipole.pipelines.fields.comparison import compare_fields
from epipole.pipelines.stereo.run import examine_stereo

URL = "https://x.org/photos.zip"
SAID = r"is the URL https://x\.org/photos\.zip, but only local files .*: download it and pass its path"


@pytest.mark.parametrize("kind", [str, Path])
@pytest.mark.parametrize(
    "call",
    [
        lambda url, out: epipole.reconstruct(url, out),
        lambda url, out: epipole.reconstruct(out, url),
        lambda url, out: epipole.reconstruct(out, out, masks=Path(url)),
        lambda url, out: epipole.slam(url, out),
        lambda url, out: epipole.slam(out, out, map=url),
        lambda url, out: epipole.splat(url, out),
        lambda url, out: epipole.nerf(url, out),
        lambda url, out: compare_fields(url, out),
        lambda url, out: epipole.render(out, out, cameras=Path(url)),
        lambda url, out: epipole.mesh(url, out),
        lambda url, out: epipole.stereo(out, url, out),
        lambda url, out: examine_stereo(url, out),
        lambda url, out: epipole.calibrate(url, out),
        lambda url, out: epipole.evaluate(out, url),
        lambda url, out: epipole.undistort(url),
        lambda url, out: epipole.convert(url, out),
        lambda url, out: epipole.view(url),
        lambda url, out: epipole.share(out, url),
    ],
)
def test_they_are_refused_everywhere(call, kind, tmp_path):
    with pytest.raises(ConfigError, match=SAID):
        call(kind(URL), tmp_path)
    assert not list(tmp_path.iterdir())


def test_other_schemes_have_advice_of_their_own(tmp_path):
    with pytest.raises(ConfigError, match=r"leave the scheme out, as in /home/me/photos"):
        epipole.reconstruct("file:///home/me/photos", tmp_path)
    with pytest.raises(ConfigError, match=r"rtsp://camera/1, .*: record the stream to a video file"):
        epipole.slam("rtsp://camera/1", tmp_path)
    for no_address in ("C:/photos", "a:b", "photos: 2024/x", "x"):
        with pytest.raises(epipole.errors.NoModelError, match="does not exist"):
            epipole.reconstruct(no_address, tmp_path)


def test_a_folder_that_is_called_like_one_is_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("https:/x.org").mkdir(parents=True)
    with pytest.raises(epipole.errors.NoModelError, match="holds no"):
        epipole.reconstruct("https://x.org", tmp_path / "out")


def test_the_command_line_says_so(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["view", URL])
    assert stopped.value.code == 2 and URL in capsys.readouterr().err
