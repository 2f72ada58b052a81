"""CSV and NPZ files with named columns, read as recordings."""

from __future__ import annotations

import numpy as np
import pytest

from dexsim import guard
from dexsim.errors import UserError
from dexsim.gap.audit import main as audited
from dexsim.recording import read, write
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
        ("desired.positions[0]", ("command", "0", "")),
        ("/arm_controller/state/actual/positions[2]", ("position", "2", "")),
        ("/hand_controller/controller_state/reference.positions.elbow", ("command", "elbow", "")),
        ("feedback.velocities[1]", ("velocity", "1", "")),
        ("desired.velocities[1]", None),
        ("error.positions[1]", None),
        ("elbow_position_ticks", ("position", "elbow", "")),
        ("goal_position_raw.elbow", ("command", "elbow", "")),
        ("target_value", ("command", "", "")),
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
    assert any(f.kind == "unit" and "position in deg" in f.text for f in s.findings)


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
    a = {"clock": T, "ziel": Q["elbow"], "wert": Q["elbow"]}
    path = csv(tmp_path / "a.csv", a)
    with pytest.raises(UserError, match="no column of position or command; columns: clock, ziel, wert"):
        read(path)
    r = read(path, {"time": "clock", "command.elbow": "ziel", "position.elbow": "wert"}, joints=["elbow"], audit=False)
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
        ("time,position.a\n" + "".join(f"{10 * i},1\n" for i in range(30)), "units.time"),
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


@pytest.mark.slow
def test_pickles_and_bombs_in_an_npz_are_refused(tmp_path, monkeypatch):
    class Boom:
        def __reduce__(self):
            return (open, (str(tmp_path / "ran"), "w"))

    np.savez(tmp_path / "a.npz", time=T, position=np.array([Boom()], dtype=object))
    with pytest.raises(UserError, match="no objects"):
        read(tmp_path / "a.npz")
    assert not (tmp_path / "ran").exists()
    monkeypatch.setattr(guard, "BYTES", 16 << 20)
    np.savez_compressed(tmp_path / "b.npz", time=np.zeros(1 << 26))
    with pytest.raises(UserError, match="b.npz.*needs more than .* of memory"):
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


def text_of(names, rows, separator=","):
    return "\n".join([separator.join(names), *(separator.join(map(str, r)) for r in rows)]) + "\n"


def test_decimal_commas_and_dates_are_numbers(tmp_path):
    path = tmp_path / "a.csv"
    rows = [(f"2026-03-03T17:37:{t:09.6f}Z", f"{q:.6f}".replace(".", ","), f"{1000 + q:.4f}".replace(".", ","))
            for t, q in zip(T, Q["elbow"], strict=True)]  # fmt: skip
    path.write_text(text_of(("timestamp", "position.elbow", "temperature.elbow"), rows, ";"))
    r = read(path, audit=False)
    assert r.start_ns == 1_772_559_420 * 10**9 and np.allclose(r.states.position.t, T, atol=1e-6)
    assert np.allclose(r.states.position.value[:, 0], Q["elbow"], atol=1e-6)
    assert np.allclose(r.temperature.value[:, 0], 1000 + Q["elbow"], atol=1e-4)
    path.write_text(text_of(("timestamp", "position.elbow"), [("yesterday", 1.0)] * 9))
    with pytest.raises(UserError, match="column 'timestamp' is neither a number nor a date"):
        read(path)


def test_a_column_is_looked_up_before_its_values_are_judged(tmp_path):
    path = tmp_path / "a.csv"
    names = ("when", "state", "note", "position.elbow", "command.elbow")
    rows = [(f"17:37:{t:05.2f}", "open", "x", q, q) for t, q in zip(T, Q["elbow"], strict=True)]
    path.write_text(text_of(names, rows))
    r = read(path, {"time": "when"}, audit=False)
    assert np.allclose(r.states.position.t, T, atol=1e-9) and len(r.findings) < 20
    with pytest.raises(UserError, match="column 'note' holds no numbers"):
        read(path, {"time": "when", "position.elbow": "note"})


def test_a_time_by_another_name_is_the_one_that_never_goes_back(tmp_path):
    path = tmp_path / "a.csv"
    rows = [(t % 0.5, t, 1.7e9 + t, q, q) for t, q in zip(T, Q["elbow"], strict=True)]
    path.write_text(text_of(("Trial_Elapsed_s", "Experiment_Elapsed_s", "Epoch", "position", "command"), rows))
    r = read(path, audit=False)
    assert np.allclose(r.states.position.t, T) and any("Experiment_Elapsed_s" in f.text for f in r.findings)


def test_one_joint_a_line(tmp_path):
    path = tmp_path / "a.csv"
    rows = [x for k, t in enumerate(T) for x in ((t, "elbow", Q["elbow"][k], Q["elbow"][k]),
                                                 (t + 0.003, "wrist", Q["wrist"][k], Q["wrist"][k]))]  # fmt: skip
    path.write_text(text_of(("time", "joint", "goal_position", "present_position"), rows))
    r = read(path)
    assert r.joints == ("elbow", "wrist") and r.states.position.carried is not None
    part = next(p for p in r.parts() if p.joints == ("wrist",))
    assert np.allclose(part.states.position.t, T + 0.003) and np.allclose(part.commands.value[:, 0], Q["wrist"])
    assert not [f for f in r.findings if f.kind in ("nan", "gap", "burst", "dropped")]


def test_a_controllers_columns_by_number_are_the_stated_joints(tmp_path):
    path = tmp_path / "a.csv"
    names = ["time", *(f"desired.positions[{k}]" for k in (0, 1)), *(f"actual.positions[{k}]" for k in (0, 1)),
             *(f"desired.velocities[{k}]" for k in (0, 1))]  # fmt: skip
    rows = zip(T, Q["elbow"], Q["wrist"], np.roll(Q["elbow"], 3), np.roll(Q["wrist"], 3), T, T, strict=True)
    path.write_text(text_of(names, rows))
    r = read(path, meta={"joint_names": "elbow,wrist"}, audit=False)
    assert r.joints == ("elbow", "wrist") and r.states.velocity is None
    assert np.allclose(r.commands.value[:, 1], Q["wrist"])


LIMITS = {"elbow": (-0.5, 1.5), "wrist": (-1.0, 1.0)}


@pytest.mark.parametrize(
    ("unit", "of"),
    [
        ("ticks:4096", lambda q: q * 4096 / (2 * np.pi)),
        ("ticks:4096@2048", lambda q: 2048 + q * 4096 / (2 * np.pi)),
        ("percent", lambda q: 100 * (q + 0.5) / 2.0),
        ("signed_percent", lambda q: 100 * (q - 0.5)),
        ("normalized", lambda q: q - 0.5),
        ("registers", lambda q: 1000 * (q + 0.5) / 2.0),
        ("registers=1.5..-0.5", lambda q: 1000 * (1.5 - q) / 2.0),
        ("range:0..255=-0.5..1.5", lambda q: 255 * (q + 0.5) / 2.0),
    ],
)
def test_units_of_a_drives_own_numbers(tmp_path, unit, of):
    q, names = Q["elbow"], ("command.elbow", "position.elbow", "velocity.elbow")
    path = csv(tmp_path / "a.csv", {"time": T} | {name: of(q) for name in names})
    r = read(path, meta={"units.position": unit}, limits=LIMITS, audit=False)
    assert np.allclose(r.commands.value[:, 0], q) and np.allclose(r.states.position.value[:, 0], q)
    slope = float(of(np.array(1.0)) - of(np.array(0.0)))
    assert np.allclose(r.states.velocity.value[:, 0], of(q) / slope)
    one = read(path, meta={"units": {"position.elbow": unit}}, limits=LIMITS, audit=False)
    assert np.array_equal(one.states.position.value, r.states.position.value)


def test_what_a_unit_lacks_is_said(tmp_path):
    path = csv(tmp_path / "a.csv", plain())
    with pytest.raises(UserError, match="its range is not known here; say it: percent=LOW..HIGH"):
        read(path, meta={"units.position": "percent"})
    with pytest.raises(UserError, match="units.position=furlong: is not read.* ticks:4096"):
        read(path, meta={"units.position": "furlong"})
    with pytest.raises(UserError, match="units.positoin: no such quantity. Did you mean"):
        read(path, meta={"units.positoin": "rad"})


WIDE = {"elbow": (-0.3, 1.5), "wrist": (-1.6, 0.3)}
GUESSES = {  # name -> (values of q rad along the joint's range u from 0 to 1, the unit, whether a model is needed)
    "ticks": (lambda q, u: np.round(2048 + q * 4096 / (2 * np.pi)), "ticks:4096@2048", False),
    "registers": (lambda q, u: np.round(1000 * u), "registers", False),
    "bytes": (lambda q, u: np.round(255 * u), "range:0..255", False),
    "percent": (lambda q, u: 100 * u, "percent", False),
    "signed": (lambda q, u: 200 * u - 100, "signed_percent", False),
    "normalized": (lambda q, u: 2 * u - 1, "normalized", True),
    "degrees": (lambda q, u: np.degrees(q), "deg", False),
}


@pytest.mark.parametrize("name", GUESSES)
@pytest.mark.parametrize("known", [True, False])
def test_units_that_nothing_states_are_guessed_with_a_warning(tmp_path, name, known):
    """By both sides and all joints together, where rad is not possible. The warning says the guess, what it rests on
    and the setting that states it; where a range is needed and not known, values are a fraction of the travel."""
    of, unit, needs_model = GUESSES[name]
    u = {"elbow": 0.5 + 0.5 * np.sin(4 * T), "wrist": 0.5 + 0.4 * np.cos(3 * T)}
    q = {j: WIDE[j][0] + u[j] * (WIDE[j][1] - WIDE[j][0]) for j in u}
    columns = {f"{what}.{j}": np.roll(of(q[j], u[j]), k) for k, what in enumerate(("command", "position")) for j in u}
    path = csv(tmp_path / "a.csv", {"time": T} | columns)
    r = read(path, limits=WIDE if known else None)
    said = [f for f in r.findings if f.kind == "unit"]
    if needs_model and not known:
        assert [f.severity for f in said] == ["warning"]
        assert "taken for rad by its values" in said[0].text and "(or normalized?)" in said[0].text
        assert np.allclose(r.commands.value[:, 0], of(q["elbow"], u["elbow"]))
        return
    assert [f.severity for f in said] == ["warning"], said
    text = said[0].text
    assert f"taken for {unit} by its" in text and f"units.position={unit}" in text
    along = not known and not unit.startswith(("ticks", "deg"))
    assert along is ("a fraction of the travel, 0 to 1, not rad. Give model=" in text)
    for k, j in enumerate(u):
        assert np.abs(r.commands.value[:, k] - (u if along else q)[j]).max() < 5e-3
    stated = read(path, meta={"units.position": unit}, limits=WIDE)
    assert not [f for f in stated.findings if "no unit is stated" in f.text]
    if along:  # what is written goes on saying so
        write(tmp_path / "a.mcap", r)
        assert np.abs(read(tmp_path / "a.mcap", limits=WIDE).commands.value[:, 0] - q["elbow"]).max() < 1e-2
        with pytest.raises(UserError, match="its range is not known here"):
            read(tmp_path / "a.mcap")


def test_a_unit_is_guessed_only_where_rad_is_not_possible(tmp_path):
    """Never of one side alone, which is a fault; a joint that hardly moves is in the unit of the others."""
    q, ticks = Q["elbow"] * 3, lambda x: np.round(2048 + x * 4096 / (2 * np.pi))
    one = csv(tmp_path / "b.csv", {"time": T, "command.elbow": q, "position.elbow": ticks(np.roll(q, 3))})
    assert {f.severity for f in read(one).findings if f.kind == "unit"} == {"error"}
    low = np.round(500 + 100 * Q["wrist"])  # alone, registers
    both = {f"{what}.{j}": x for what in ("command", "position") for j, x in (("elbow", ticks(q)), ("wrist", low))}
    r = read(csv(tmp_path / "c.csv", {"time": T} | both))
    assert np.abs(r.commands.value[:, 1] - (low - 2048) * 2 * np.pi / 4096).max() < 1e-9
    turns = 40 * Q["elbow"]
    wheel = csv(tmp_path / "d.csv", {"time": T, "command.elbow": turns, "position.elbow": np.roll(turns, 3)})
    assert np.allclose(read(wheel, limits={}).commands.value[:, 0], turns)  # of a model without limits
    square = np.where(np.sin(5 * T) > 0, 1.0, -1.0)
    path = csv(tmp_path / "e.csv", {"time": T, "command.elbow": square, "position.elbow": np.roll(square, 3)})
    assert not [f for f in read(path, limits=LIMITS).findings if f.kind == "unit"]


def test_recordings_that_are_guessed_apart_are_said(tmp_path, capsys):
    """Percent that reaches its ends in one recording only, and elsewhere looks like degrees."""
    paths = []
    for name, size in (("a.csv", 50.0), ("b.csv", 20.0)):
        u = 50 + size * np.sin(4 * T)
        paths.append(str(csv(tmp_path / name, {"time": T, "command.elbow": u, "position.elbow": np.roll(u, 3)})))
    audited(paths)
    said = capsys.readouterr().out
    assert "by its values taken for percent here, for deg in b.csv" in said and "State units.position=" in said


def test_a_column_may_say_that_it_is_along_its_range(tmp_path):
    u = 20 + 10 * np.sin(4 * T)
    path = csv(tmp_path / "a.csv", {"time": T, "command.elbow [%]": u, "position.elbow [%]": u})
    r = read(path, limits=LIMITS)
    (f,) = [f for f in r.findings if f.kind == "unit"]
    assert np.allclose(r.commands.value[:, 0], -0.5 + 2.0 * u / 100) and "percent by the name of its column" in f.text
    assert np.allclose(read(path).commands.value[:, 0], u / 100)


def test_a_current_of_hundreds_is_in_milliamperes(tmp_path):
    table = {"time": T, "command.elbow": Q["elbow"], "position.elbow": Q["elbow"], "current.elbow": 300.25 + 50 * T}
    r = read(csv(tmp_path / "a.csv", table))
    assert np.allclose(r.states.effort.value[:, 0], 0.30025 + 0.05 * T)
    assert any(f.kind == "unit" and f.severity == "warning" and "effort" in f.text for f in r.findings)
