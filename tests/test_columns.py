"""CSV and NPZ files with named columns, read as recordings."""

from __future__ import annotations

import numpy as np
import pytest

from dexsim.errors import UserError
from dexsim.recording import columns, read
from dexsim.recording.columns import _role
from dexsim.recording.convert import convert

T = np.arange(0, 2, 0.01)
Q = {"elbow": 0.3 * np.sin(3 * T), "wrist": 0.2 * np.cos(2 * T)}


def csv(path, table, separator=","):
    rows = [separator.join(table)] + [
        separator.join("" if np.isnan(x) else f"{x:.17g}" for x in row) for row in zip(*table.values(), strict=True)
    ]
    path.write_text("\n".join(rows) + "\n")
    return path


def plain(scale=1.0, start=0.0):
    out = {"time": start + T}
    for j, q in Q.items():
        out |= {f"command.{j}": scale * q, f"position.{j}": scale * np.roll(q, 3), f"torque.{j}": q}
    return out


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("position.elbow", ("position", "elbow", "")),
        ("Elbow Position (deg)", ("position", "Elbow", "deg")),
        ("goal_position.a", ("command", "a", "")),
        ("time_ms", ("time", "", "ms")),
        ("time.command", ("time", "command", "")),
        ("left_elbow_pitch_velocity_rpm", ("velocity", "left_elbow_pitch", "rpm")),
        ("/joint_commands/elbow/position", ("command", "elbow", "")),
        ("position[3]", ("position", "3", "")),
        ("current_2 (mA)", ("effort", "2", "ma")),
        ("quality", None),
        ("index", None),
        ("q.elbow", ("position", "elbow", "")),
    ],
)
def test_what_a_column_is(name, role):
    found = _role(name)
    assert (found and found[:3]) == role


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_a_csv_is_a_recording(tmp_path, separator):
    r = read(csv(tmp_path / "a.csv", plain(), separator), audit=False)
    assert r.joints == ("elbow", "wrist") and r.effort_is == "torque_Nm" and r.start_ns == 0
    assert np.allclose(r.commands.value, np.stack(list(Q.values()), 1), atol=1e-8) and np.allclose(
        r.states.position.t, T
    )
    assert np.allclose(r.states.effort.value[:, 0], Q["elbow"], atol=1e-8) and r.states.velocity is None


def test_units_stand_in_a_name_or_in_meta_and_are_converted_once(tmp_path):
    a = {k + ("_deg" if k.startswith(("command", "position")) else ""): v for k, v in plain(180 / np.pi).items()}
    a["time_ms"] = 1e3 * a.pop("time") + 1.7e12
    a["current.elbow (mA)"] = 1e3 * a.pop("torque.elbow")
    a["current.wrist (mA)"] = 1e3 * a.pop("torque.wrist")
    r = read(csv(tmp_path / "a.csv", a), audit=False)
    s = read(csv(tmp_path / "b.csv", plain(180 / np.pi)), meta={"position_unit": "deg"}, audit=False)
    for x in (r, s):
        assert np.allclose(x.commands.value[:, 1], Q["wrist"], atol=1e-6)
    assert r.effort_is == "current_A" and np.allclose(r.states.effort.value[:, 0], Q["elbow"], atol=1e-6)
    assert r.start_ns == pytest.approx(1.7e18) and np.allclose(r.states.position.t, T, atol=1e-3)
    assert any(f.kind == "unit" and "position_unit=deg" in f.text for f in s.findings)


def test_an_npz_with_arrays_is_the_same_recording(tmp_path):
    joints = list(Q)
    stack = np.stack(list(Q.values()), 1)
    np.savez(
        tmp_path / "a.npz",
        time=T,
        command_time=T[::2],
        command=stack[::2],
        position=stack,
        joint_names=joints,
        temperature=np.full((200, 2), 30.0),
    )
    r = read(tmp_path / "a.npz", audit=False)
    assert (
        r.joints == tuple(joints)
        and len(r.commands) == 100
        and len(r.states.position) == 200
        and r.temperature.value.shape == (200, 2)
    )


def test_columns_and_joints_called_otherwise_are_named(tmp_path):
    a = {"clock": T, "soll": Q["elbow"], "ist": Q["elbow"]}
    path = csv(tmp_path / "a.csv", a)
    with pytest.raises(UserError, match="no column of position or command; columns: clock, soll, ist"):
        read(path)
    r = read(path, {"time": "clock", "command.elbow": "soll", "position.elbow": "ist"}, joints=["elbow"], audit=False)
    assert r.joints == ("elbow",) and np.allclose(r.commands.value[:, 0], Q["elbow"], atol=1e-8)
    s = read(csv(tmp_path / "b.csv", plain()), {"upper": "elbow"}, joints=["upper"], audit=False)
    assert s.joints == ("upper",)
    with pytest.raises(UserError, match="has no column 'sol'"):
        read(path, {"time": "clock", "command.elbow": "sol"})


def test_missing_cells_are_missing_samples(tmp_path):
    a = plain()
    for j in Q:
        a[f"command.{j}"] = np.where(np.arange(200) % 10 == 0, a[f"command.{j}"], np.nan)
    r = read(csv(tmp_path / "a.csv", a), audit=False)
    assert len(r.commands) == 20 and len(r.states.position) == 200


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "no line of column names"),
        ("1,2\n3,4\n", "no line of column names"),
        ("time,position.a,position_a\n0,1,2\n", "are both position of a"),
        ("time,time\n0,1\n", "two columns"),
        ("position.a\n1\n", "comma"),
        ("x,position.a\n0,1\n0,1\n", "no column of time"),
        ("time,position,position.a,command.b\n" + "0,1,1,1\n" * 9, "names no joint"),
        ("time,position.a [furlong]\n0,1\n", None),
        ("time,position.a\n" + "".join(f"{10 * i},1\n" for i in range(30)), "meta.time_unit"),
        ("time,torque.a,current.b,position.a\n0,1,1,1\n", "current in one"),
        ("time,position.a [rpm]\n0,1\n", "not read"),
    ],
)
def test_bad_files_get_one_line(tmp_path, text, why):
    path = tmp_path / "a.csv"
    path.write_text(text)
    if why is None:
        read(path)
        return
    with pytest.raises(UserError, match=why) as error:
        read(path)
    assert "\n" not in str(error.value) and "a.csv" in str(error.value)


def test_pickles_and_bombs_in_an_npz_are_refused(tmp_path, monkeypatch):
    class Boom:
        def __reduce__(self):
            return (open, (str(tmp_path / "ran"), "w"))

    np.savez(tmp_path / "a.npz", time=T, position=np.array([Boom()], dtype=object))
    with pytest.raises(UserError, match="no objects"):
        read(tmp_path / "a.npz")
    assert not (tmp_path / "ran").exists()
    monkeypatch.setattr(columns, "MAX_BYTES", 1 << 20)
    np.savez_compressed(tmp_path / "b.npz", time=np.zeros(1 << 18))
    with pytest.raises(UserError, match="unpacks to"):
        read(tmp_path / "b.npz")


def test_convert_writes_what_is_read(tmp_path):
    path = csv(tmp_path / "a.csv", plain())
    convert(path, tmp_path / "a.mcap", {}, {"gravity": "0 0 0"})
    a, b = read(path, audit=False), read(tmp_path / "a.mcap", audit=False)
    assert (
        np.allclose(a.states.position.value, b.states.position.value)
        and b.meta["gravity"] == "0 0 0"
        and b.joints == a.joints
    )
    with pytest.raises(UserError, match="exists"):
        convert(path, tmp_path / "a.mcap", {}, {})


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_columns_without_a_name_are_the_model_s_one_joint(tmp_path, suffix):
    t, path = np.arange(0.0, 2.0, 0.01), tmp_path / f"log{suffix}"
    if suffix == ".npz":
        np.savez(path, time=t, command=np.sin(t), position=np.sin(t - 0.1))
    else:
        rows = [f"{a:.3f},{np.sin(a):.6f},{np.sin(a - 0.1):.6f}" for a in t]
        path.write_text("\n".join(["time,command,position", *rows]))
    r = read(path, joints=["elbow"])
    assert r.joints == ("elbow",) and np.allclose(r.states.position.value[:, 0], np.sin(t - 0.1), atol=1e-5)
    assert any("they are taken for the model's one, elbow" in f.text for f in r.findings)
    assert read(path, {"elbow": "joint"}, joints=["elbow"]).joints == ("elbow",)
    assert read(path, joints=["elbow", "joint"]).joints == ("joint",)
    with pytest.raises(UserError, match="none of its joints"):  # which of two?
        read(path, joints=["elbow", "wrist"])
    named = tmp_path / "named.csv"
    named.write_text("time,command.knee,position.knee\n" + "".join(f"{a:.3f},0,{a:.3f}\n" for a in t))
    with pytest.raises(UserError, match="none of its joints"):  # a name that is another's
        read(named, joints=["elbow"])
