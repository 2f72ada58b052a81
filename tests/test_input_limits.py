"""Sizes, depths, stamps and kinds of file: beyond a stated limit there is one line that names it, soon and in little
memory."""

from __future__ import annotations

import os
import time
import tracemalloc

import numpy as np
import pytest
import recordings
import yaml

from dexsim import guard
from dexsim.actuator.table import ServoTable
from dexsim.calibration.file import Calibration
from dexsim.calibration.rubber import read_curve
from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.recording import Recording, Series, States, Writer, read, write
from dexsim.recording.schema import COMMANDS, STATES
from dexsim.tactile import file as tactile_file

pytestmark = pytest.mark.limits

LOADERS = {"servo": ServoTable.load, "calibration": Calibration.load, "tactile": tactile_file.load}
BOMBS = {
    "aliases": "a: &a [1,1,1,1,1,1,1,1,1]\n"
    + "".join(f"{b}: &{b} [{','.join(['*' + a] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)),
    "merges": "a: &a {x: 1}\n" + "".join(f"b{i}: &b{i} {{<<: [{','.join(['*a'] * 50)}]}}\n" for i in range(50)),
    "deep": "[" * 5000,
    "deep maps": "{a: " * 3000,
    "itself": "a: &a [*a]",
    "python": "!!python/object/apply:os.system [exit]",
    "binary": "\x00\x01",
    "big": "a: " + "x" * (5 << 20),
}


@pytest.mark.parametrize(("what", "bomb"), [("servo", bomb) for bomb in BOMBS] + [(what, "deep") for what in LOADERS])
def test_yaml_bombs_end_in_one_line(tmp_path, what, bomb):
    """Each in one kind of file, and one in each: all are parsed by one function."""
    path = tmp_path / "f.yaml"
    path.write_text(BOMBS[bomb])
    start = time.process_time()
    with pytest.raises(UserError) as error:
        LOADERS[what](path)
    assert "f.yaml" in str(error.value) and "\n" not in str(error.value) and time.process_time() - start < 3


@pytest.mark.parametrize("bomb", BOMBS)
def test_yaml_beside_a_recording_and_in_its_metadata(tmp_path, bomb):
    made = recordings.signal(0.5)
    write(tmp_path / "a.mcap", made)
    (tmp_path / "a.mcap.yaml").write_text(BOMBS[bomb])
    with pytest.raises(UserError, match="a.mcap.yaml"):
        read(tmp_path / "a.mcap")
    if bomb not in ("binary", "big"):
        made.meta["servo"] = BOMBS[bomb]
        write(tmp_path / "b.mcap", made)
        with pytest.raises(UserError, match="b.mcap"):
            read(tmp_path / "b.mcap")


@pytest.mark.parametrize(
    "reader",
    [
        *LOADERS.values(),
        read,
        lambda p: read(p.with_suffix(".csv")),
        lambda p: read(p.with_suffix(".npz")),
        checkpoint.load,
        read_curve,
    ],
    ids=[*LOADERS, "mcap", "csv", "npz", "checkpoint", "curve"],
)
@pytest.mark.parametrize("kind", ["fifo", "zero"])
def test_devices_and_pipes_are_no_files(tmp_path, reader, kind):
    for end in (".mcap", ".csv", ".npz"):
        path = tmp_path / f"f{end}"
        if kind == "fifo":
            os.mkfifo(path)
        else:
            path.symlink_to("/dev/zero")
    with pytest.raises(UserError, match="a device, a pipe or a socket"):
        reader(tmp_path / "f.mcap")


def test_a_chunk_that_unpacks_to_more_than_is_allowed_is_lost_and_said(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    with Writer(path, ("a",), chunk_bytes=1 << 30, chunk_s=1e9) as w:
        for i in range(3):
            w.add_state(0.01 * i, np.zeros(1))
        w.flush()
        w.add_state(1.0, np.zeros(20_000_000))  # packs to next to nothing
    monkeypatch.setattr(guard, "BYTES", 100 << 20)
    r = read(path)
    assert len(r.states.position) == 3 and any(f.kind == "damage" and "a chunk of" in f.text for f in r.findings)


@pytest.mark.parametrize("at", [1e8, 6e2, 3.6e3])
def test_nothing_is_allocated_by_span_of_time(tmp_path, at):
    """Half of the samples far later than the others: read, audited and cut in two without a grid over the time
    between."""
    from dexsim.gap.read import Run, channels, inputs

    made = recordings.signal(8.0)
    for s in (made.commands, made.states.position, made.states.velocity, made.states.effort):
        s.t = np.where(np.arange(len(s.t)) < 400, s.t, s.t + at)
        s.stamp = None
    made.temperature = made.supply_voltage = None
    write(tmp_path / "a.mcap", made)
    tracemalloc.start()
    r = read(tmp_path / "a.mcap")
    import mujoco

    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="a"/><joint name="b" axis="0 1 0"/><geom '
        'size=".1"/></body></worldbody></mujoco>'
    )
    run = Run(
        "a",
        r.joints,
        r.commands.t,
        r.commands.value,
        r.states.position.t,
        r.states.position.value,
        ServoTable(),
        r.gravity,
    )
    blind = channels.inspect([run], model, {})[2]
    pieces, _ = inputs.free_air([run], [], blind, [], "", "", (0.0, 0.0), inputs.SHORTEST)
    assert tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()
    assert [len(p.t) for p in pieces] == [400, 400] and all(p.duration < 5 for p in pieces)


@pytest.mark.parametrize("joints", [2, 600])
def test_reading_is_linear_in_samples_and_joints(tmp_path, joints):
    """12,000 samples of two joints and 20 of 600: what was quadratic took minutes."""
    n = 24_000 // joints
    t = 0.01 * np.arange(n)
    names = tuple(f"j{i:04d}" for i in range(joints))
    x = np.zeros((n, joints)) + np.sin(t)[:, None]
    made = Recording(
        tmp_path / "x",
        recordings.META | {"joint_names": ",".join(names)},
        names,
        Series(t, x, COMMANDS),
        States(Series(t, x, STATES)),
    )
    write(tmp_path / "a.mcap", made)
    start = time.process_time()
    assert len(read(tmp_path / "a.mcap", audit=False).joints) == joints
    assert time.process_time() - start < 6


def test_bombs_load_the_plain_file_again(tmp_path):
    path = tmp_path / "s.yaml"
    path.write_text(yaml.safe_dump({"joints": {"*": {"kp": 1.0}}}))
    assert ServoTable.load(path).value("a", "kp").value == 1.0
