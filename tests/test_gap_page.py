"""report.html in a real browser: it renders, nothing overflows, nothing is fetched, every figure has a size."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from benchmarks import press_rig
from dexsim.gap import demo
from dexsim.gap.diagnosis import Settings, diagnose, save
from dexsim.gap.report.files import grouped

CHROMIUM = next(
    (p for name in ("chromium", "chromium-browser", "google-chrome", "chrome") if (p := shutil.which(name))), None
)
PROBE = """<script>
window.onload = function () {
  var out = {width: document.documentElement.scrollWidth, height: document.documentElement.scrollHeight,
             inner: window.innerWidth, figures: [],
             first: document.querySelector('h1').getBoundingClientRect().bottom,
             fetched: performance.getEntriesByType('resource').length, long: []};
  document.querySelectorAll('svg').forEach(function (s) { var b = s.getBoundingClientRect();
             out.figures.push([b.width, b.height, s.querySelectorAll('*').length]); });
  document.querySelectorAll('svg text').forEach(function (t) {
    var b = t.getBoundingClientRect(), s = t.ownerSVGElement.getBoundingClientRect();
    if (b.right > s.right + 2 || b.left < s.left - 2) out.long.push(t.textContent);
  });
  document.body.setAttribute('data-probe', JSON.stringify(out));
};
</script>"""


def opened(page: Path, width: int = 1120) -> dict:
    """What headless Chromium makes of the page, measured in it."""
    text = page.read_text(encoding="utf-8")
    probed = page.with_name("probed.html")
    probed.write_text(text.replace("</body>", PROBE + "</body>"), encoding="utf-8")
    done = subprocess.run(
        [
            CHROMIUM,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            f"--user-data-dir={page.parent / 'profile'}",
            f"--window-size={width},1400",
            "--virtual-time-budget=3000",
            "--dump-dom",
            probed.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    start = done.stdout.index('data-probe="') + len('data-probe="')
    return json.loads(done.stdout[start : done.stdout.index('"', start)].replace("&quot;", '"'))


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """A page of a joint, one of touch, and one of recordings that cannot be used."""
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
        allowed={"command_delay", "lag", "coulomb_friction"},  # others are more rows of the same tables
    )
    paths, model, servo = press_rig.record(folder / "touch", 2, 5.0, gains={54: 0.4, 66: 0.0})
    out["touch"] = Settings(paths, folder / "touch_out", None, str(model), str(servo), next_recording=False)
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


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here (Debian, Ubuntu: apt-get install chromium)")
@pytest.mark.parametrize("name", ["joint", "touch", "unusable"])
@pytest.mark.parametrize("width", [1120, 560])
def test_page_renders_in_a_browser(pages, name, width):
    seen = opened(pages[name], width)
    assert seen["width"] <= seen["inner"]  # nothing sticks out sideways
    assert seen["first"] < 420  # the verdict is read without scrolling
    assert seen["fetched"] == 0
    if name != "unusable":
        assert len(seen["figures"]) >= 4 and all(w > 60 and h > 15 and parts > 2 for w, h, parts in seen["figures"])
        assert not seen["long"], seen["long"]


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here (Debian, Ubuntu: apt-get install chromium)")
def test_page_is_not_blank(pages, tmp_path):
    from PIL import Image

    shot = tmp_path / "page.png"
    subprocess.run(
        [
            CHROMIUM,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--hide-scrollbars",
            f"--user-data-dir={tmp_path / 'p'}",
            "--window-size=1120,1600",
            f"--screenshot={shot}",
            pages["joint"].as_uri(),
        ],
        check=True,
        capture_output=True,
        timeout=120,
    )
    image = np.asarray(Image.open(shot).convert("RGB")).astype(int)
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
    from dexsim.gap.report.sections import Findings, render
    from dexsim.gap.report.sentence import sentence
    from dexsim.gap.result import Diagnosis, empty

    def found(effect: str, confidence: float, key: str) -> dict:
        return {
            "effect": effect,
            "confidence": confidence,
            "where": {"joints": ["knee"], "taxels": [], "topics": []},
            "regime": "somewhere",
            "when": [],
            "alternatives": [],
            "indistinguishable": [],
            "separating_experiment": None,
            "held_out": {"before": 0.02, "after": 0.01},
            "parameters": {key: {"value": 0.01, "low": 0.005, "high": 0.02, "unit": "s"}},
        } | ({"hint": True} if confidence < 0.5 else {})

    data = empty("partly_explained")
    data["held_out"] |= {"before": 0.02, "after": 0.01}
    data["findings"] = [found("command_delay", 0.9, "delay"), found("lag", 0.3, "time_constant")]
    d = Diagnosis(data, "", [])
    html = render(Findings(d))
    missing, hints = html.split("<h2>Hints</h2>")
    assert "delay" in missing and "lag" not in missing.lower().replace("lagg", "") and "lag" in hints.lower()
    said = sentence(data, d, 0.001)
    assert "later than believed" in said and "more" not in said
    data["findings"] = data["findings"][1:]
    data["verdict"] = "unknown"
    assert "What is missing" not in render(Findings(d)) and "no effect of the catalogue explains" in sentence(
        data, d, 0.001
    )


def test_what_recordings_say_is_text_and_no_markup():
    from dexsim.gap.report.sections import page
    from dexsim.gap.result import Diagnosis, empty

    text = page(Diagnosis(empty(), "a <b>sentence</b> & more", ["<script>alert(1)</script>"]))
    assert "<script" not in text and "&lt;script&gt;" in text and "a &lt;b&gt;sentence&lt;/b&gt; &amp; more" in text
