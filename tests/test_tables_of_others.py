"""Tables as loggers, spreadsheets and drives write them: encodings, separators, clocks, names and units."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dexsim.errors import UserError
from dexsim.recording import read
from dexsim.recording.columns import _role

T = np.arange(0, 4, 0.01)
GOAL = 0.5 + 0.4 * np.sin(2 * T)
SHOWN = 0.5 + 0.4 * np.sin(2 * (T - 0.04))
NAMES = ("time", "command.elbow", "position.elbow")


def table(names=NAMES, columns=(T, GOAL, SHOWN), separator=",", form="{:.12g}"):
    rows = [
        separator.join(x if isinstance(x, str) else form.format(x) for x in row) for row in zip(*columns, strict=True)
    ]
    return [separator.join(names), *rows]


def text(lines, encoding="utf-8"):
    return "\n".join([*lines, ""]).encode(encoding)


def twice(lines):
    """Return the lines of a logger that is started again, the last one cut."""
    return [*lines[:200], lines[0], *lines[200:], lines[-1][:9]]


COMMA = [x.replace(".", ",") for x in table(("Zeit", "command", "position"), separator=";")]
RECORDS = np.array(list(zip(T, GOAL, SHOWN, strict=True)), [("time", "f8"), ("cmd", "f8"), ("pos", "f8")])
BY_NAME = {"t": T.tolist(), "goal": GOAL.tolist(), "pos": SHOWN.tolist()}
ROWS = [{"timestamp": t, "motor": {"goal_position": c, "present_position": q}} for t, c, q in RECORDS.tolist()]
FILES = {
    "spreadsheet.csv": text(COMMA, "utf-8-sig"),
    "powershell.csv": text(table(), "utf-16"),
    "ansi.csv": text(["# Prüfstand", *table(("time", "command [°]", "position [°]"),
                                            (T, np.degrees(GOAL), np.degrees(SHOWN)))], "cp1252"),
    "blanks.txt": text(table(separator="   ")),
    "tabs.dat": text(table(separator="\t")),
    "quotes.csv": text([",".join(f'"{x}"' for x in line.split(",")) for line in table()]),
    "again.csv": text(twice(table())),
    "pandas.csv": text(table(("", *NAMES), (np.arange(len(T)), T, GOAL, SHOWN))),
    "epoch_ms.csv": text(table(columns=(1772584678779 + 1e3 * T, GOAL, SHOWN), form="{:.15g}")),
    "epoch_ns.csv": text(table(columns=([str(1772584678779000000 + round(1e9 * t)) for t in T], GOAL, SHOWN))),
    "lerobot.csv": text(table(("time", "action.elbow.pos", "observation.state.elbow.pos"))),
    "plotted.csv": text(table(("__time", "/joint_commands/elbow/position", "/joint_states/elbow/position"))),
    "rows.json": json.dumps({"kp": 200, "entries": ROWS}).encode(),
    "rows.jsonl": text(map(json.dumps, ROWS)),
    "lists.json": json.dumps(BY_NAME).encode(),
    "stamps.jsonl": text(json.dumps({"stamp": {"sec": 7 + int(round(100 * t) // 100), "nanosec": round(1e9 * (t % 1))},
                                     "name": ["elbow"], "position": [q], "command": [c]})
                         for t, c, q in zip(np.round(T, 2), GOAL, SHOWN, strict=True)),
    "dates.csv": text(table(("Datum", "target.elbow", "actual.elbow"), (
        [f"03.11.2026 09:00:{t:06.3f}".replace(".", ",", 9).replace(",", ".", 2) for t in T], GOAL, SHOWN),
        separator=";")),
    "records.npz": {"log": RECORDS},
    "step.npz": {"dt": 0.01, "q_cmd": GOAL, "q": SHOWN},
    "fps.npz": {"fps": 100, "q_cmd": GOAL[:, None], "q": SHOWN[:, None]},
    "comment.txt": text(["# time cmd pos", *table(separator=" ")[1:]]),
    "own_clocks.npz": {"t_cmd": T, "cmd": GOAL, "t": T, "pos": SHOWN, "tau_abs": np.abs(GOAL - SHOWN)},
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_a_table_is_read_as_it_was_written(tmp_path, name):
    content, path = FILES[name], tmp_path / name
    if isinstance(content, dict):
        np.savez(path, **content)
    else:
        path.write_bytes(content)
    r = read(path)
    assert len(r.joints) == 1
    t, q, c = r.states.position.t, r.states.position.value[:, 0], r.commands.value[:, 0]
    assert len(t) == len(T) and np.allclose(t, T, atol=2e-6)
    assert np.allclose(q, SHOWN, atol=1e-6) and np.allclose(c, GOAL, atol=1e-6)
    said = " ".join(f.text for f in r.findings)
    assert ("since 1970" in said) is name.startswith("epoch") and ("started again" in said) is (name == "again.csv")


@pytest.mark.parametrize(
    ("column", "role"),
    {
        "current_mA.elbow": ("effort", "elbow", "ma"), "elbow_current_mA": ("effort", "elbow", "ma"),
        "current[mA].elbow": ("effort", "elbow", "ma"), "position_deg.elbow": ("position", "elbow", "deg"),
        "t_cmd": ("time", "command", ""), "t": ("time", "", ""), "timestamps": ("time", "", ""),
        "tau_abs.j2": ("effort", "j2", ""), "Present_Position_3": ("position", "3", ""),
        "id3_goal_position": ("command", "id3", ""), "goal_current": None, "goal_velocity": None,
        "goal_velocity.a": None, "desired_torque.a": None, "measured_torque.a": ("effort", "a", ""),
        "target_positions.a": ("command", "a", ""), "joint_positions.a": ("position", "a", ""),
        "cmd_pos_0": ("command", "0", ""), "pos_0": ("position", "0", ""), "observation.a": ("position", "a", ""),
        "thumb_present_ticks": ("position", "thumb", ""), "q_meas.a": ("position", "a", ""),
        "actions.a": ("command", "a", ""), "/joint_states/position[1]": ("position", "1", ""),
        "/hand/commands/data[0]": ("command", "0", ""), "field.position2": ("position", "2", ""),
        "obs.q.a": ("position", "a", ""), "position.s": ("position", "s", ""),
        "time_s": ("time", "", "s"), "Soll a [°]": ("command", "a", "°"), "duty [1]": ("duty", "", "1"),
        "Moment a [Nm]": ("effort", "a", "nm"),
        "position.a [%]": ("position", "a", "%"), "a_pos_pct": ("position", "a", "pct"),
        "current_position_elbow": ("position", "elbow", ""), "observation.velocity.a": ("velocity", "a", ""),
    }.items(),
)  # fmt: skip
def test_a_columns_name_says_what_it_is(column, role):
    found = _role(column)
    assert (found if found is None else found[:3]) == role


def test_arrays_without_names_take_those_that_are_stated(tmp_path):
    np.savez(tmp_path / "a.npz", time=T, cmd=np.stack([GOAL, SHOWN], 1), pos=np.stack([SHOWN, GOAL], 1))
    r = read(tmp_path / "a.npz", meta={"joint_names": "shoulder,elbow"})
    assert r.joints == ("shoulder", "elbow") and np.allclose(r.commands.value[:, 1], SHOWN)
    text_ = text(table(("time", "command.joint1", "position.joint1")))
    (tmp_path / "b.csv").write_bytes(text_)
    assert read(tmp_path / "b.csv", meta={"joint_names": "joint1,joint2"}).joints == ("joint1",)  # names, no numbers


def test_a_table_without_positions_says_so(tmp_path):
    (tmp_path / "a.csv").write_bytes(text(table(("time", "command.elbow", "seen_elbow"))))
    (f,) = [f for f in read(tmp_path / "a.csv").findings if f.kind == "missing_topic"]
    assert f.severity == "error" and "no positions" in f.text and "remap.position.JOINT" in f.text


def test_a_large_effort_of_no_stated_kind_is_asked_about(tmp_path):
    current = 900 * (GOAL - SHOWN) / np.abs(GOAL - SHOWN).max()
    (tmp_path / "a.csv").write_bytes(text(table((*NAMES, "effort.elbow"), (T, GOAL, SHOWN, current))))
    (f,) = [f for f in read(tmp_path / "a.csv").findings if f.kind == "unit"]
    assert "a current in mA? State meta.effort_is=current_A units.effort=mA" in f.text
    r = read(tmp_path / "a.csv", meta={"effort_is": "current_A", "units.effort": "mA"})
    assert np.nanmax(np.abs(r.states.effort.value)) == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.json", b"{", "is not JSON"), ("a.json", b"[1, 2]", "no list of mappings"),
        ("a.jsonl", b'{"t": 0}\n{', "is not JSON"), ("a.txt", b"\0\1\2", "no text file"),
        ("a.txt", b"hello\nworld\n", "no comma, semicolon, tab or blank"),
        ("a.csv.gz", b"\x1f\x8b\x08\0", "packed: unpack it first, `gunzip a.csv.gz`"),
    ],
)  # fmt: skip
def test_what_is_no_table_is_one_line(tmp_path, name, content, says):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=says) as error:
        read(tmp_path / name)
    assert "\n" not in str(error.value)


def test_names_that_are_objects_say_how_to_save_them(tmp_path):
    np.savez(tmp_path / "a.npz", time=T, cmd=GOAL, pos=SHOWN, joint_names=np.array(["elbow"], object))
    with pytest.raises(UserError, match=r"names as text: np.array\(names, dtype=str\)"):
        read(tmp_path / "a.npz")


def test_an_encoder_that_passes_its_end_is_read_round_its_zero(tmp_path):
    """A servo of one turn that goes from 4095 to 0 within its motion: the audit says how to read it."""
    ticks = [np.round(100 + x * 4096 / (2 * np.pi)) % 4096 for x in (GOAL - 0.5, SHOWN - 0.5)]
    (tmp_path / "a.csv").write_bytes(text(table(columns=(T, *ticks))))
    r = read(tmp_path / "a.csv")
    assert any("taken for ticks:4096@0 by its whole numbers" in f.text for f in r.findings)
    assert np.abs(np.diff(r.states.position.value[:, 0])).max() < 0.1
    r = read(tmp_path / "a.csv", meta={"units.position": "ticks:4096@100"})
    assert not any(f.kind == "wrap" for f in r.findings)
    assert np.allclose(r.states.position.value[:, 0], SHOWN - 0.5, atol=2e-3)
    # of several turns, as a drive in extended mode counts them, nothing is folded
    (tmp_path / "b.csv").write_bytes(text(table(columns=(T, *(np.round(9000 * x) for x in (GOAL, SHOWN))))))
    r = read(tmp_path / "b.csv", meta={"units.position": "ticks:4096@100"})
    assert np.ptp(r.states.position.value) == pytest.approx(np.ptp(np.round(9000 * SHOWN)) * 2 * np.pi / 4096)
