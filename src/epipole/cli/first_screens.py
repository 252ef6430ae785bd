"""What `epipole COMMAND --help` shows first: two examples and the options that people use most; and groups of all options."""

from __future__ import annotations

from typing import NamedTuple


class FirstScreen(NamedTuple):
    """First screen of a command's help."""

    examples: tuple[str, ...]
    options: str = ""
    """At most ten, separated by spaces."""


FIRST_SCREENS = {
    "reconstruct": FirstScreen(
        (
            "epipole reconstruct IMAGES OUT",
            "epipole reconstruct walk.mp4 OUT --max-frames 100",
        ),
        (
            "--calibration --camera-params --camera-model --single-camera --include --masks "
            "--max-frames --pairing.method --features.max-features --threads"
        ),
    ),
    "merge": FirstScreen(
        ("epipole merge MODEL1 MODEL2 OUT",),
        (
            "--calibration --camera-params --camera-model --single-camera --rigs --pairing.neighbors "
            "--features.max-features --mapper.use-gps --threads"
        ),
    ),
    "localize": FirstScreen(
        (
            "epipole localize NEW WORKSPACE",
            "epipole localize photo.jpg WORKSPACE OUT",
        ),
        (
            "--calibration --camera-params --camera-model --include --masks --max-frames --threads "
            "--neighbors --min-inliers"
        ),
    ),
    "georeference": FirstScreen(
        (
            "epipole georeference WORKSPACE --gcp gcp_list.txt",
            "epipole georeference WORKSPACE OUT --gcp gcp_list.txt --check P4 --check P9",
        ),
        (
            "--gcp --check --gcp-sigma-m --gcp-height-sigma-m --mark-sigma-px --use-gps --gps-sigma-m "
            "--refine-cameras --seed --threads"
        ),
    ),
    "surface": FirstScreen(
        (
            "epipole surface PHOTOS OUT",
            "epipole surface WORKSPACE OUT --until cloud",
        ),
        "--until --max-size-px --sources --images --masks --voxel --min-component --texture-px --formats --threads",
    ),
    "slam": FirstScreen(
        (
            "epipole slam rgbd_dataset_freiburg1_xyz OUT",
            "epipole slam ride.mp4 OUT --calibration camera.yaml",
        ),
        (
            "--sensor --calibration --camera-params --map --localize --truth --view --imu "
            "--max-frames --resume"
        ),
    ),
    "splat": FirstScreen(
        (
            "epipole splat PHOTOS OUT --time 5m",
            "epipole splat MODEL OUT --steps 3000 --view",
        ),
        (
            "--time --steps --test-every --max-side-px --masks --background --view --max-gaussians "
            "--refine-poses --exposure"
        ),
    ),
    "nerf": FirstScreen(
        (
            "epipole nerf SOURCE OUT --time 5m",
            "epipole nerf SOURCE OUT --kind grid",
        ),
        "--time --steps --test-every --max-side-px --masks --background --view --kind --seed",
    ),
    "render": FirstScreen(
        (
            "epipole render OUT video.mp4",
            "epipole render OUT images --cameras scene/transforms.json",
        ),
        "--cameras --path --frames --width --height --fps --background --output",
    ),
    "mesh": FirstScreen(
        (
            "epipole mesh OUT mesh.ply",
            "epipole mesh OUT mesh.ply --voxels 400",
        ),
        "--voxels --box --box-fraction --max-views --min-component",
    ),
    "compare-fields": FirstScreen(
        (
            "epipole compare-fields SOURCE OUT --time 1m",
            "epipole compare-fields SOURCE OUT --steps 2000 --kind grid",
        ),
        "--time --steps --test-every --max-side-px --masks --background --view --kind --seed",
    ),
    "stereo": FirstScreen(
        (
            "epipole stereo left.png right.png OUT --calibration calibration.json",
            "epipole stereo --workspace MODEL --pair a.jpg b.jpg OUT",
        ),
        (
            "--calibration --focal-px --baseline --max-disparity-px --max-sigma-px --fill "
            "--uncalibrated --workspace --pair --strict"
        ),
    ),
    "stereo-doctor": FirstScreen(
        (
            "epipole stereo doctor left.png right.png",
            "epipole stereo doctor LEFT RIGHT --calibration FILE --json",
        ),
        "--calibration --focal-px --baseline --json --strict",
    ),
    "calibrate": FirstScreen(
        (
            "epipole calibrate BOARDS OUT --columns 9 --rows 6 --square 0.025",
            "epipole calibrate LEFT OUT --right RIGHT --kind charuco --columns 8 --rows 6",
        ),
        "--kind --columns --rows --square --right --model --dictionary --strict",
    ),
    "demo": FirstScreen(
        (
            "epipole demo",
            "epipole demo OUT --num-views 12",
        ),
        "--num-views",
    ),
    "lesson": FirstScreen(
        (
            "epipole lesson",
            "epipole lesson --export PAGES",
        ),
        "--export --port --host",
    ),
    "view": FirstScreen(
        (
            "epipole view OUT",
            "epipole view OUT --share page.html",
        ),
        "--share --share-max --port --host",
    ),
    "evaluate": FirstScreen(
        (
            "epipole evaluate OUT --truth DIR",
            "epipole evaluate trajectory.txt --truth groundtruth.txt --json",
        ),
        "--truth --max-difference-s --json",
    ),
    "undistort": FirstScreen(
        (
            "epipole undistort OUT",
            "epipole undistort OUT DEST --model 1",
        ),
        "--model",
    ),
    "convert": FirstScreen(
        (
            "epipole convert OUT SCENE --format transforms",
            "epipole convert OUT cloud.ply",
        ),
        "--format",
    ),
    "completion": FirstScreen(
        (
            "epipole completion bash > ~/.local/share/bash-completion/completions/epipole",
            "epipole completion fish > ~/.config/fish/completions/epipole.fish",
        ),
    ),
    "version": FirstScreen(
        ("epipole version",),
    ),
}
GROUPS = {
    "camera": (
        "--camera-model --camera-params --calibration --refine-known --single-camera --readout-s "
        "--depth-scale --focal-px --baseline --principal-point --principal-offset-px --focal-sigma-px "
        "--baseline-sigma --principal-offset-sigma-px"
    ),
    "scale": (
        "--known-poses --known-poses-sigma-m --known-poses-sigma-deg "
        "--positions --positions-sigma-m --lengths --lengths-sigma-m --clicks-sigma-px --tag-size-m "
        "--tag-family --board --square-m --size-sigma --odometry --odometry-sigma --odometry-mounting "
        "--imu --imu-mounting --imu-units"
    ),
    "live view": "--view --port --host",
    "tracking and mapping": (
        "--window-px --levels --max-return-px --min-eigenvalue --num-features --min-distance-px "
        "--corner-quality --max-error-px --min-tracked --keyframe-fraction --keyframe-motion "
        "--keyframe-rotation --keyframe-points --keyframe-gap --min-angle-deg --triangulation-angle-deg --start-angle-deg "
        "--lost-patience --window --max-fixed --depth-sigma-px --sensor-baseline-m --focal-sigma "
        "--center-sigma-px --depth-sigma --max-depth-baselines"
    ),
    "matching": (
        "--min-disparity-px --search --method --block-px --paths --brightness-cost --small-penalty "
        "--edge-penalty --edge-fade --left-right --max-left-right-px --min-margin --min-region-px "
        "--median-px"
    ),
}
"""Options, separated by spaces, by the title of their group; the others stay under `options`."""
