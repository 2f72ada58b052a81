"""Recordings with spikes and stamps that jump: the same name as without them, as sure."""

from __future__ import annotations

import numpy as np
import pytest

from dexsim.gap import demo
from dexsim.gap.diagnosis import Settings, diagnose
from dexsim.recording import Writer, read, write

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rig")
    paths, model, servo, _ = demo.make(folder, "command_delay")
    return [read(p, joints=["joint"], audit=False) for p in paths], model, servo, {}


def named(rig, folder, changes):
    """Return the first finding of the recordings, each as its own change makes it (None: as it is), and the
    diagnosis."""
    recordings, model, servo, known = rig
    folder.mkdir(parents=True)
    paths = []
    for k, (r, change) in enumerate(zip(recordings, changes, strict=True)):
        paths.append(folder / f"{k}.mcap")
        copy = read(r.path, joints=["joint"], audit=False)
        if change is not None:
            change(copy, paths[-1], np.random.default_rng(k))
        else:
            write(paths[-1], copy)
    d = diagnose(Settings(paths, folder / "out", None, str(model), str(servo), next_recording=False, replay="none",
                          allowed={"command_delay", "viscous_friction", "coulomb_friction", "lag"}), say=lambda _: None)
    return [f for f in d.data["findings"] if f["effect"] != "bad_channel"][0], d


def spikes(quantity, share, size):
    def change(r, path, rng):
        series = {"position": r.states.position, "command": r.commands, "effort": r.states.effort}[quantity]
        at = rng.choice(len(series), int(share * len(series)), replace=False)
        series.value[at, 0] += size * rng.choice([-1, 1], len(at))
        write(path, r)

    return change


def stamps(jump, share):
    """share of the samples, or (None) all of the second half."""

    def change(r, path, rng):
        n = len(r.states.position)
        late = np.arange(n) > n // 2 if share is None else rng.random(n) < share
        half = float(r.states.position.t[n // 2])
        rows = [(t, 1, i, t + (jump if late[i] else 0.0)) for i, t in enumerate(r.states.position.t)]
        rows += [
            (t, 0, i, t + (jump if (t > half if share is None else rng.random() < share) else 0.0))
            for i, t in enumerate(r.commands.t)
        ]
        with Writer(path, r.joints, r.meta, r.start_ns + 10**13) as w:
            for _, kind, i, stamp in sorted(rows):
                if kind:
                    w.add_state(
                        stamp,
                        r.states.position.value[i],
                        None,
                        None if r.states.effort is None else r.states.effort.value[i],
                    )
                else:
                    w.add_command(stamp, r.commands.value[i])

    return change


CHANGES = {
    "position2": spikes("position", 0.02, 1.5),
    "position5": spikes("position", 0.05, 0.5),
    "command5": spikes("command", 0.05, 1.0),
    "effort5": spikes("effort", 0.05, 5.0),
    "back": stamps(-3.0, 0.05),
    "ahead": stamps(600.0, 0.05),
    "far": stamps(1e18 * 1e-9, 0.02),
    "set back": stamps(-1.5, None),
}
MIXED = (("position2", "back", "command5", "far"), ("ahead", "effort5", "set back", "position5"))
"""A change a recording: each stands beside three others, and comes once."""


@pytest.mark.parametrize("names", [*((name,) * 4 for name in CHANGES), *MIXED], ids=[*CHANGES, "mixed", "mixed too"])
def test_the_same_name_as_sure(rig, tmp_path, names):
    known = rig[3]
    if "clean" not in known:
        known["clean"] = named(rig, tmp_path / "clean", (None,) * 4)[0]
    clean = known["clean"]
    found, d = named(rig, tmp_path / "changed", [CHANGES[name] for name in names])
    print("DISTURBED", clean["effect"], clean["confidence"], found["effect"], found["confidence"], d.notes[:3])
    assert found["effect"] == clean["effect"] and found["confidence"] > clean["confidence"] - 0.1
    said = [n for n in d.notes if "left out" in n]
    assert {f"{k}.mcap" for k in range(4)} <= {word.rstrip(":,") for n in said for word in n.split()}, said
