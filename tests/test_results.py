"""The results page: made from `docs/results/data/`, whole, and with nothing in it that the data do not hold."""

from __future__ import annotations

import datetime
import json
import re

import pytest

from tools import results

SAMPLE = {
    "title": "Sample",
    "order": 1,
    "about": "A sample.",
    "measurements": [
        {
            "what": "Runs",
            "command": "dexsim train task=grasp seed=SEED",
            "date": "2026-11-26",
            "hardware": "two CPU cores",
            "version": "0123456789ab",
            "figures": [{"name": "held", "unit": "%", "by_seed": {"1": 96.5, "2": 91.7, "3": 95.5}, "aim": "95"}],
        }
    ],
}


def _written(tmp_path, **changes):
    """Write the sample, with changes to its one figure, and return the file."""
    sample = json.loads(json.dumps(SAMPLE))
    sample["measurements"][0]["figures"][0].update(changes)
    path = tmp_path / "sample.json"
    path.write_text(json.dumps(sample))
    return path


def test_page_and_schema_agree_with_the_data():
    for path, text in results.outputs().items():
        assert path.read_text(encoding="utf-8") == text, f"{path.name}: run python -m tools.results"


def test_page_shows_every_figure_of_every_topic():
    page = (results.RESULTS / "index.md").read_text(encoding="utf-8")
    found = results.topics()
    assert len(found) > 10 and page.count("\n") <= results.LONGEST
    for topic in found.values():
        for m in topic.measurements:
            assert m.command in page and all(f"| {f.name} |" in page for f in m.figures)


def test_page_shows_mean_and_range_over_seeds(tmp_path):
    line = results.page([results.read(_written(tmp_path))])
    assert "| held | 94.6 % | 91.7 to 96.5, range of 3 seeds | 95 |" in line
    assert "`dexsim train task=grasp seed=SEED`, 26 November 2026, two CPU cores, version 0123456789ab." in line


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"value": 3}, "held: give either value or by_seed"),
        ({"by_seed": None}, "held: give either value or by_seed"),
        ({"by_seed": {"1": 96.5}}, "held: by_seed needs two seeds or more"),
        ({"by_seed": None, "value": 3, "low": 4, "high": 5, "interval": "95 %"}, "held: 3 is outside 4 to 5"),
        ({"by_seed": None, "value": 3, "low": 1, "high": 5}, "held: low, high and interval belong together"),
        ({"vlaue": 3}, "unknown field `vlaue`"),
        ({"name": "a | b"}, "matching regex"),
    ],
)
def test_faulty_figure_is_refused_with_file_and_field(tmp_path, changes, fault):
    path = _written(tmp_path, **changes)
    with pytest.raises(ValueError, match=re.escape(fault)) as caught:
        results.read(path)
    assert str(path) in str(caught.value)


def test_benchmark_adds_a_measurement_and_replaces_it_by_name(tmp_path):
    path = _written(tmp_path)
    new = results.Measurement(
        what="Speed",
        command="python -m benchmarks.step",
        date=datetime.date(2026, 11, 26),
        hardware="two CPU cores",
        version="0123456789ab",
        figures=[results.Figure(name="steps a second", value=1_849_000)],
    )
    assert results.record("sample", new, tmp_path) == path
    new.figures[0].value = 2_000_000
    results.record("sample", new, tmp_path)
    whole = results.read(path)
    assert [m.what for m in whole.measurements] == ["Runs", "Speed"]
    assert "| steps a second | 2,000,000 |" in results.page([whole])


def test_numbers_keep_their_digits():
    assert [results.number(v) for v in (1_849_000, 0.98, 2.5e-7, 0, "19 of 20")] == [
        "1,849,000", "0.98", "2.5e-07", "0", "19 of 20",
    ]  # fmt: skip
