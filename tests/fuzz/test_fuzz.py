"""The short run: damaged files of each kind end in an answer or in one line that names the file.

A few of each kind here: continuous integration damages 2,700 beside the tests (`python -m tests.fuzz kind=ci`).
"""

from __future__ import annotations

import os
import shutil
import time
import warnings

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dexsim.recording import write

from . import __main__ as program
from . import corpus, mutate, silence, strategies, targets

pytestmark = pytest.mark.limits

SHORT = settings(
    max_examples=10, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), database=None
)
WELL = ("fine", "refused")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return corpus.build(tmp_path_factory.mktemp("corpus"))


@pytest.fixture(autouse=True)
def quiet():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@pytest.mark.slow
def test_the_corpus_itself_is_sound(files, tmp_path):
    for kind, paths in files.items():
        for path in paths:
            mutate.clean(tmp_path)
            copy = tmp_path / f"case{''.join(path.suffixes)}"
            if kind in ("manifest", "network"):
                shutil.copytree(path.parent, copy := tmp_path / "case")
            elif path.is_dir():
                shutil.copytree(path, copy)
            else:
                copy.write_bytes(path.read_bytes())
            assert targets.verdict(kind, copy) == "fine", path


@pytest.mark.parametrize("kind", sorted(corpus.TREES))
def test_damaged_trees(kind, tmp_path):
    @SHORT
    @given(strategies.trees(kind))
    def run(tree):
        mutate.clean(tmp_path)
        path = tmp_path / "case.yaml"
        path.write_text(
            yaml.dump(tree, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper), allow_unicode=True),
            encoding="utf-8",
            errors="surrogatepass",
        )
        assert targets.verdict(kind, path) in WELL

    run()


@pytest.mark.parametrize("kind", sorted(targets.TARGETS))
def test_damaged_files(kind, files, tmp_path):
    @settings(SHORT, max_examples=3)
    @given(strategies.seeds)
    def run(seed):
        mutate.clean(tmp_path)
        assert targets.verdict(kind, mutate.case(kind, seed, files, tmp_path)) in WELL

    run()


FOUND = [
    ("servo", 307),
    ("metadata", 58),
    ("metadata", 274),
    ("recording", 324),
    ("recording", 1416),
    ("calibration", 1898),
    ("tactile", 3033),
    ("checkpoint", 96),
    ("checkpoint", 0),
    ("checkpoint", 1165),
    ("overrides", 1153),
    ("recording", 70119),
    ("recording", 1004148),
    ("manifest", 1018735),
    ("checkpoint", 1008330),
    ("checkpoint", 1011057),
    ("overrides", 1017359),
    ("calibration", 3000179),
    ("tactile", 3005553),
    ("tactile", 3012168),
    ("overrides", 3017267),
    ("checkpoint", 4000029),
    ("overrides", 9004328),
    ("recording", 10004427),
    ("calibration", 10004780),
    ("recording", 775265925),
]
"""Cases of long runs that once broke something."""


@pytest.mark.parametrize(("kind", "seed"), FOUND)
def test_what_once_broke(kind, seed, files, tmp_path):
    assert targets.verdict(kind, mutate.case(kind, seed, files, tmp_path)) in WELL


def test_settings_taken_for_others_are_found():
    said = {"a": {"kp": 1.5, "kd": [0.01, 0.03]}, "delay": {"value": 2, "low": 1, "high": 3}, "none": None}
    taken = {"a": {"kp": 1.5, "kd": {"value": 0.02, "low": 0.01, "high": 0.03}}, "delay": [1.0, 3.0]}
    assert silence.of_settings(said, taken) == ""
    assert silence.of_settings({"a": {"kp": 9.0}}, {"a": {"kp": 5.0}}) == "a.kp=9.0 was taken for 5.0"
    assert silence.of_settings({"a": 1, "b": 2}, {"a": 1}) == "b=2 was left out"
    assert silence.of_settings({"a": 1}, {"a": [1.0, 1.0]}) == ""
    assert silence.of_settings({"a": 1}, {"a": [1.0, 2.0]}) and silence.of_settings({"a": 1}, {"a": [2.0, 2.0]})


@pytest.mark.parametrize(
    ("change", "wrong", "silent"),
    [
        (lambda r: None, "", ""),
        (lambda r: r.states.position.value.__setitem__((slice(60, 64), 0), 0.9), "position of a", "position of a"),
        (lambda r: setattr(r.commands, "t", r.commands.t + 0.3), "command of", ""),
        (lambda r: r.states.position.value.__setitem__((slice(60, 150, 10), 0), 2.0), "", ""),
    ],
    ids=["sound", "four samples in a row, too many for a spike", "late, and said", "spikes, left out"],
)
def test_a_recording_used_for_another_is_found(change, wrong, silent, tmp_path):
    """What is wrong, and what of it is not said."""
    r = corpus.recording(3.0, tactile=False)
    r.states.position.value[:3] = silence.signal(r.states.position.t[:3] - 0.03)
    change(r)
    write(tmp_path / "x.mcap", r)
    _, runs, reported = targets._used(tmp_path / "x.mcap")
    reported -= targets._always()
    for words, expected in ((set(), wrong), (reported, silent)):
        found = silence.of_recording(tmp_path / "x.mcap", r, runs, words)
        assert found.startswith(expected) and bool(found) == bool(expected), found


@given(st.text(max_size=80))
@SHORT
def test_any_name_of_a_column(text):
    from dexsim.recording.columns import _role

    assert _role(text) is None or len(_role(text)) == 4


def test_a_crash_ends_its_case_alone(tmp_path, monkeypatch, capfd):
    """Among eight cases in batches of four one ends its process and one raises: six are fine, and each is said."""

    def one(kind, seed, files, folder):
        if seed == 1:
            os._exit(7)
        return ("traceback" if seed == 5 else "fine"), "KeyError: 'x'" * (seed == 5), folder / "case"

    monkeypatch.setattr(program, "one", one)
    monkeypatch.setattr(program, "BATCH", 4)
    run = program.Run(["config"], 0, 8, tmp_path, {})
    run.go(2, time.monotonic() + 60)
    assert run.counts == {"fine": 6, "crash": 1, "traceback": 1} and run.next == 8
    assert run.broken == {"crash 7": ["config 1"], "KeyError: 'x'": ["config 5"]}
    said = capfd.readouterr().out
    assert "config from=1: ended its process with 7" in said and "config from=5: traceback" in said
