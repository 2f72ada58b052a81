"""report.html in a real browser: it renders, nothing overflows, nothing is fetched, every figure has a size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import press_rig
import pytest
from browser import CHROMIUM, Page

from dexsim.gap import demo
from dexsim.gap.diagnosis import Settings, diagnose, save
from dexsim.gap.finding import Finding, gathered
from dexsim.gap.report.files import grouped

PROBE = """(() => {
  const out = {width: document.documentElement.scrollWidth, inner: window.innerWidth, figures: [],
               first: document.querySelector('h1').getBoundingClientRect().bottom,
               fetched: performance.getEntriesByType('resource').length, long: []};
  document.querySelectorAll('svg').forEach(s => { const b = s.getBoundingClientRect();
               out.figures.push([b.width, b.height, s.querySelectorAll('*').length]); });
  document.querySelectorAll('svg text').forEach(t => {
    const b = t.getBoundingClientRect(), s = t.ownerSVGElement.getBoundingClientRect();
    if (b.right > s.right + 2 || b.left < s.left - 2) out.long.push(t.textContent);
  });
  return out;
})()"""
"""What a browser makes of a page, measured in it."""


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("no chromium here (Debian, Ubuntu: apt-get install chromium)")
    page = Page("about:blank")
    yield page
    page.close()


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Return a page of a joint, one of touch, and one of recordings that cannot be used."""
    folder = tmp_path_factory.mktemp("pages")
    out = {}
    paths, model, servo, _ = demo.make(folder / "joint", "command_delay", seconds=4.0, joint="knuckle")
    out["joint"] = Settings(
        paths,
        folder / "joint_out",
        None,
        str(model),
        str(servo),
        next_recording=False,
        allowed={"command_delay"},  # others are more rows of the same tables
    )
    paths, model, servo = press_rig.record(folder / "touch", 2, 5.0, gains={54: 0.4, 66: 0.0})
    out["touch"] = replace(
        out["joint"], recordings=paths, out=folder / "touch_out", model=str(model), servo=str(servo),
        allowed={"tactile_gain"},
    )  # fmt: skip
    from dexsim.recording import read, write

    r = read(paths[0])
    r.tactile = r.external_force = None
    r.commands.value[:] = 0
    r.states.position.value[:] = 0
    write(folder / "still.mcap", r)
    out["unusable"] = Settings(
        [folder / "still.mcap"], folder / "still_out", None, str(model), str(servo), next_recording=False
    )
    for s in out.values():
        save(diagnose(s, say=lambda _: None), s.out)
    return {name: s.out / "report.html" for name, s in out.items()}


@pytest.fixture(scope="module")
def page_of_all(tmp_path_factory):
    """Return the page of touch where every effect was tried."""
    folder = tmp_path_factory.mktemp("all")
    paths, model, servo = press_rig.record(folder, 2, 5.0, gains={54: 0.4, 66: 0.0})
    s = Settings(paths, folder / "out", None, str(model), str(servo), next_recording=False)
    save(diagnose(s, say=lambda _: None), s.out)
    return s.out / "report.html"


@pytest.mark.parametrize("name", ["joint", "touch", "unusable"])
@pytest.mark.parametrize("width", [1120, 560])
def test_page_renders_in_a_browser(pages, browser, name, width):
    renders(pages[name], browser, width, name != "unusable")


@pytest.mark.slow
@pytest.mark.parametrize("width", [1120, 560])
def test_page_of_every_effect_of_touch_renders_in_a_browser(page_of_all, browser, width):
    renders(page_of_all, browser, width, True)


def renders(page, browser, width, figures):
    browser.show(page.as_uri(), width, 1400)
    seen = browser.js(PROBE)
    assert seen["inner"] == width and seen["width"] <= width  # nothing sticks out sideways
    assert seen["first"] < 420  # the verdict is read without scrolling
    assert seen["fetched"] == 0 and not browser.log
    if figures:
        assert len(seen["figures"]) >= 4 and all(w > 60 and h > 15 and parts > 2 for w, h, parts in seen["figures"])
        assert not seen["long"], seen["long"]


@pytest.mark.slow
def test_page_is_not_blank(pages, browser, tmp_path):
    from PIL import Image

    browser.show(pages["joint"].as_uri(), 1120, 1600, scale=1.0)
    image = np.asarray(Image.open(browser.screenshot(tmp_path / "page.png")).convert("RGB")).astype(int)
    assert image.shape == (1600, 1120, 3)
    red, blue = np.array([209, 73, 91]), np.array([23, 104, 172])
    for colour in (red, blue):  # both curves and bars are there
        assert (np.abs(image - colour).max(-1) < 12).sum() > 500


def test_notes_that_recordings_share_are_said_once():
    assert grouped(["a.mcap: x", "b.mcap: x", "c.mcap: y", "plain: note"]) == [
        "a.mcap, b.mcap: x",
        "c.mcap: y",
        "plain: note",
    ]


def test_hints_stand_apart_and_are_not_in_the_first_sentence():
    from dexsim.gap.inquiry import Diagnosis, empty
    from dexsim.gap.judge.conclude import sentence
    from dexsim.gap.judge.confidence import Evidence
    from dexsim.gap.report.files import Findings, render

    def found(effect: str, confidence: float, key: str) -> Finding:
        held, size = {"before": 0.02, "after": 0.01}, {"value": 0.01, "low": 0.005, "high": 0.02, "unit": "s"}
        hint = confidence < 0.5
        return Finding(effect, confidence, "somewhere", ["knee"], held_out=held, parameters={key: size}, hint=hint)

    data = empty("partly_explained")
    data["held_out"] |= {"before": 0.02, "after": 0.01}
    d = Diagnosis(data, "", [], [found("command_delay", 0.9, "delay"), found("lag", 0.3, "time_constant")])
    d.evidence = [Evidence("command_delay", "knee", 0.97, 1.0, 0.15, 0.0, 9.0, 1, ["x"])]
    d.findings[0] = replace(d.findings[0], alternatives=[{"effect": "stribeck_friction", "confidence": 0.03}])
    html = render(Findings(d))
    why = "Why 90 %: of the redraws command delay wins 97 %, stribeck friction wins 3 %; times 1.00"
    assert why in html and "0.75 for what stays" in html and "less for doubts" in html
    missing, hints = html.split("<h2>Hints</h2>")
    assert "delay" in missing and "lag" not in missing.lower().replace("lagg", "") and "lag" in hints.lower()
    said = sentence(data, d, 0.001)
    assert "later than believed" in said and "more" not in said
    d.findings = d.findings[1:]
    data["verdict"] = "unknown"
    assert "What is missing" not in render(Findings(d)) and "no effect of the catalogue explains" in sentence(
        data, d, 0.001
    )


def test_what_recordings_say_is_text_and_no_markup():
    from dexsim.gap.inquiry import Diagnosis, empty
    from dexsim.gap.report.files import page

    text = page(Diagnosis(empty(), "a <b>sentence</b> & more", ["<script>alert(1)</script>"]))
    assert "<script" not in text and "&lt;script&gt;" in text and "a &lt;b&gt;sentence&lt;/b&gt; &amp; more" in text


def test_one_fault_of_many_signals_is_one_card():
    def one(j, kind):
        return Finding("bad_channel", 0.9, f"{kind}: {j} is", [j])

    lag = Finding("lag", 0.9, "", ["a"])
    given = [one("a", "sign"), lag, one("b", "sign"), one("a", "stale"), *(one(j, "sign") for j in "cde")]
    out = gathered(given)
    assert [f.effect for f in out] == ["bad_channel", "lag", "bad_channel"]
    assert out[0].regime == "sign: a is (the same in 5 signals, of a, b, c and 2 more)"
    assert out[2].regime == "stale: a is"
