"""The replays of the page on failures: what it shows is what was recorded, and what is recorded is what the library does."""

import itertools
import json
import re
from dataclasses import replace
from importlib import resources

import numpy as np
from benchmarks.lesson_replays import failures, recorded

from whole import IS_WHOLE

RECORD = json.loads(resources.files("epipole.lesson").joinpath("assets", "failures.json").read_text())


def stated(run, which):
    """Places that were known: a camera that only turns, or has no map yet, has none."""
    unknown = ("turning", "starting") if which == "place" else ("turning",)
    return [None if state in unknown else position for position, state in zip(run[which], run["state"])]


def rms_cm(positions, truth):
    off = [np.subtract(position, true) for position, true in zip(positions, truth) if position]
    return 100 * np.sqrt(np.mean(np.sum(np.square(off), axis=1))) if off else np.nan


def test_a_replay_shows_what_was_recorded(tab):
    tab.open("10_failures.html")
    failures = sorted(RECORD.keys() - {"kitchen"})
    for failure in failures if IS_WHOLE else failures[::3]:
        tab.page.check(f"input[name=failure][value={failure}]")
        check_replays(tab, failure)


def check_replays(tab, failure):
    for number, (name, run) in enumerate(RECORD[failure].items()):
        if len(RECORD[failure]) > 1:
            tab.page.check(f"input[name=run][value='{number}']")
        count = len(run["state"])
        assert tab.page.locator("#frame").get_attribute("max") == str(count - 1)
        for k in (0, count // 3, count - 1):
            tab.set(frame=k)
            shown, position = tab.shown(), stated(run, "place")[k]
            off = 100 * np.linalg.norm(np.subtract(position, run["truth"][k])) if position else np.nan
            wanted = {
                "points": run["points"][k],
                "off_now": off,
                "final_off": rms_cm(stated(run, "final"), run["truth"]),
                "placed": 100 * sum(p is not None for p in stated(run, "place")) / count,
            }
            for what, value in wanted.items():
                np.testing.assert_allclose(
                    shown[what], value, rtol=1e-9, atol=1e-9, err_msg=f"{failure} {name} {what}"
                )
            for id, verdict in (("refused", "rejected"), ("accepted", "accepted")):
                count_then = sum(loop == verdict for seen, loop in run["loops"] if seen <= k)
                assert shown[id] == count_then, (failure, name, k, id)
            state = tab.page.locator("#state").get_attribute("data-state")
            reason = tab.page.locator("#reason").inner_text()
            assert (state, reason) == (run["state"][k], run["reason"][k] or "–"), (failure, name, k)


def test_what_a_run_says_is_told_in_chinese_too(tab):
    tab.open("10_failures.zh.html")
    said = {
        reason for runs in failures() for run in RECORD[runs].values() for reason in run["reason"] if reason
    }
    reasons = sorted(said)
    for reason, words in zip(reasons, tab.page.evaluate("said => said.map(reasonOf)", reasons), strict=True):
        assert re.search("[\u4e00-\u9fff]", words) and not re.search("[a-z]", words), words
        assert re.findall(r"[\d.]+", reason) == re.findall(r"[\d.]+", words)


def test_it_plays_and_stops(tab):
    tab.open("10_failures.html")
    tab.page.check("input[name=failure][value=rotation]")
    tab.page.click("#play")
    slider, last = tab.page.locator("#frame"), 0.0
    while last < 2:  # a page's policy forbids Playwright's own way of waiting
        tab.page.wait_for_timeout(50)
        assert float(slider.input_value()) >= last
        last = float(slider.input_value())
    tab.page.click("#play")
    stopped = slider.input_value()
    tab.page.wait_for_timeout(300)
    assert slider.input_value() == stopped
    assert tab.page.locator("#play").inner_text() == "play"


def test_the_two_truths_of_the_kitchen(tab):
    tab.open("10_failures.html")
    shown = tab.shown()
    for name in ("sfm_fusion", "ours_fusion", "ours_sfm"):
        np.testing.assert_allclose(
            shown[f"rms-{name}"], 100 * np.sqrt(np.mean(np.square(RECORD["kitchen"][name]))), rtol=1e-9
        )
    assert shown["rms-ours_sfm"] < shown["rms-sfm_fusion"] < shown["rms-ours_fusion"]


def test_every_run_is_there_and_says_what_its_text_tells():
    assert {name: set(runs) for name, runs in failures().items()} == {
        name: set(runs) for name, runs in RECORD.items() if name != "kitchen"
    }
    states = {(name, run): set(given["state"]) for name in failures() for run, given in RECORD[name].items()}
    assert "lost" in states["wall", "rgbd"] and "submap" in states["wall", "rgbd"]
    assert states["rotation", "mono"] == {"turning"}
    off = {
        (name, run): rms_cm(given["final"], given["truth"])
        for name, runs in RECORD.items()
        if name != "kitchen"
        for run, given in runs.items()
    }
    assert off["blur", "long"] > 3 * off["blur", "short"]
    assert off["shutter", "untold"] > 2 * off["shutter", "told"]
    tiles = RECORD["tiles"]["rgbd"]
    assert len(tiles["loops"]) > 100 and all(verdict != "accepted" for _, verdict in tiles["loops"])
    assert any(itertools.chain(RECORD["moving"]["rgbd"]["moving"]))


def first_frames(ride, count):
    return replace(ride, timestamp_s=ride.timestamp_s[:count])


def test_the_record_is_what_the_library_does():
    sight, given = failures()["rotation"]["mono"], RECORD["rotation"]["mono"]
    count = len(given["state"]) if IS_WHOLE else 6
    found = recorded(sight._replace(ride=first_frames(sight.ride, sight.every * count)))
    assert found["state"] == given["state"][:count] and len(found["reason"]) == count
    assert found["loops"] == [loop for loop in given["loops"] if loop[0] < count]
    np.testing.assert_allclose(found["truth"], given["truth"][:count], atol=2e-3)
