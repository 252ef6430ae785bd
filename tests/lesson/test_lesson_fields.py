"""The page on fields: it sums what was recorded by the written-out rule, and what is recorded is what the library draws."""

import json
from importlib import resources

import numpy as np
import pytest
from benchmarks.lesson_fields import marched, operations_of_query, splatted

from epipole.cameras import Camera
from epipole.fields.nerf.hash_field import HashField, Room, new_weights, render_hash
from epipole.fields.splat.rasterizer import render
from epipole.geometry import Rigid3
from epipole.scene.gaussian_cloud import GaussianCloud

RECORD = json.loads(resources.files("epipole.lesson").joinpath("assets", "fields.json").read_text())
CAMERA, WHITE = Camera("PINHOLE", 64, 48, [60.0, 60.0, 31.5, 23.5]), np.ones(3, np.float32)


def summed(trajectory, pixel, upto=np.inf, record=RECORD):
    """Sum of T_i alpha_i c_i with T_i the product of (1 - alpha_j) before it; its weights, what is left, distances."""
    part = pixel[trajectory]
    if trajectory == "nerf":
        alpha = -np.expm1(-np.array(part["thickness"]))
    else:
        alpha = np.minimum(
            np.array(part["opacity"]) * np.exp(np.array(part["power"])), record["largest_alpha"]
        )
        alpha[alpha < record["least_alpha"]] = 0.0
    distance, over = np.array(part["distance"]), record["over_nerf" if trajectory == "nerf" else "over"]
    alpha[distance > upto] = 0.0
    before = np.concatenate([[1.0], np.cumprod(1.0 - alpha)])[: len(alpha)]
    alpha[before <= over] = 0.0
    weights, through = before * alpha, np.prod(1.0 - alpha)
    color = weights @ np.array(part["color"]).reshape(-1, 3) + through
    return {"used": np.count_nonzero(alpha), "weights": weights.sum(), "through": through} | {
        "depth": weights @ distance / weights.sum() if weights.any() else np.nan,
        "red": color[0],
        "green": color[1],
        "blue": color[2],
    }


@pytest.mark.parametrize("number", range(len(RECORD["pixels"])))
def test_a_pixel_is_summed_as_it_is_written(tab, number):
    tab.open("11_fields.html")
    tab.page.check(f"input[name=pixel][value='{number}']")
    for upto in (*np.linspace(RECORD["near"], RECORD["far"], 7), RECORD["far"]):
        tab.set(upto=upto)
        shown = tab.shown()
        for trajectory in ("nerf", "splat"):
            for name, value in summed(trajectory, RECORD["pixels"][number], upto).items():
                np.testing.assert_allclose(
                    shown[f"{name}-{trajectory}"],
                    value,
                    rtol=1e-9,
                    atol=1e-12,
                    err_msg=f"{name} {trajectory} {upto}",
                )
            np.testing.assert_allclose(
                shown[f"weights-{trajectory}"] + shown[f"through-{trajectory}"], 1.0, atol=1e-12
            )


def test_what_is_summed_is_what_was_drawn():
    for pixel in RECORD["pixels"]:
        for trajectory in ("nerf", "splat"):
            found = summed(trajectory, pixel)
            np.testing.assert_allclose(
                [found[c] for c in ("red", "green", "blue")], pixel["drawn"][trajectory], atol=2e-3
            )


def test_a_click_chooses_the_nearest_pixel(tab):
    tab.open("11_fields.html")
    column, row = RECORD["pixels"][2]["at"]
    tab.page.locator("#pictures").scroll_into_view_if_needed()
    box = tab.page.locator("#pictures").bounding_box()
    size = box["width"] / (3 * RECORD["side"] + 20)
    left = RECORD["side"] + 10 + column  # in the second image
    tab.page.mouse.click(box["x"] + size * (left + 3), box["y"] + size * (row + 22))
    assert tab.page.locator("input[name=pixel]:checked").get_attribute("value") == "2"


def test_figures_are_those_of_the_comparison(tab):
    tab.open("11_fields.html")
    shown, rows, each = tab.shown(), RECORD["rows"], RECORD["operations"]
    assert shown["operations-nerf"] == rows["nerf"]["queries"] * each["query"]
    assert shown["operations-splat"] == rows["splat"]["evaluated"] * each["pair"]
    assert shown["faster"] == rows["splat"]["frames_s"] / rows["nerf"]["frames_s"]
    for trajectory, row in rows.items():
        assert (
            shown[f"psnr-{trajectory}"] == row["psnr"] and shown[f"frames_s-{trajectory}"] == row["frames_s"]
        )


def test_what_is_recorded_of_gaussians_is_what_is_drawn():
    rng = np.random.default_rng(0)
    n = 200
    cloud = GaussianCloud(
        means_in_world=np.column_stack([rng.uniform(-1, 1, (n, 2)), rng.uniform(2, 4, n)]).astype(np.float32),
        log_scales=np.full((n, 3), -2.0, np.float32),
        quats_wxyz=rng.normal(size=(n, 4)).astype(np.float32),
        opacity_logits=rng.normal(size=n).astype(np.float32),
        sh=rng.normal(size=(n, 1, 3)).astype(np.float32),
    )
    rendered = render(cloud, CAMERA, Rigid3.identity())
    image = rendered.over(WHITE)
    for at in ((31, 23), (5, 40), (60, 2)):
        found = summed("splat", {"splat": splatted(rendered, CAMERA, at)})
        np.testing.assert_allclose(
            [found[c] for c in ("red", "green", "blue")], image[at[1], at[0]], atol=2e-3
        )


def test_what_is_recorded_of_a_neural_field_is_what_is_drawn():
    rng = np.random.default_rng(0)
    room = Room(
        np.ones((16, 16, 16), np.uint8), np.ones((2, 2, 2), np.uint8), np.array([-1.0, -1.0, 2.0]), 2 / 16
    )
    tables = rng.normal(size=(8, 2**12, 4)).astype(np.float32)
    weights = list(new_weights(rng, 8, 64))
    weights[1][:, 0] += np.float32(0.15)  # dense enough to be seen
    field = HashField(room, np.array([4, 5, 6, 8, 10, 12, 14, 16]), tables, tuple(weights))
    image, _, _ = render_hash(field, CAMERA, Rigid3.identity(), WHITE)
    seen = []
    for at in ((31, 23), (20, 30), (1, 1)):
        found = summed("nerf", {"nerf": marched(field, CAMERA, Rigid3.identity(), at)})
        np.testing.assert_allclose(
            [found[c] for c in ("red", "green", "blue")], image[at[1], at[0]], atol=2e-3
        )
        seen.append(found["weights"])
    assert max(seen) > 0.3
    assert 15_000 < operations_of_query(field) < 25_000
