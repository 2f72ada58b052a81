"""The page "Your log in five minutes": each command of its table, on a file of that kind."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import test_readers
import test_recordings_of_others as others

from dexsim.cli import main as cli

PAGE = Path(__file__).resolve().parents[1] / "docs" / "howto" / "your_log.md"
COMMANDS = re.findall(r"^\|.*\| `(dexsim .*)` \|$", PAGE.read_text(encoding="utf-8"), re.M)
T = np.arange(0, 3, 0.01)
Q = {j: 0.5 + 0.4 * np.sin(2 * T + k) for k, j in enumerate(("shoulder", "elbow"))}
TOPICS = ("/joint_states", "/joint_commands")
LATE = {j: np.interp(T - 0.04, T, q) for j, q in Q.items()}


def lines(path, names, columns, separator=",", form=lambda x: f"{x:.9g}"):
    rows = [separator.join(x if isinstance(x, str) else form(x) for x in row) for row in zip(*columns, strict=True)]
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join([separator.join(names), *rows]) + "\n")


def plain(path, scale=lambda q: q):
    names = ["time", *(f"command.{j}" for j in Q), *(f"position.{j}" for j in Q)]
    lines(path, names, [T, *map(scale, Q.values()), *map(scale, LATE.values())])


def moved(topics, names=("shoulder", "elbow")):
    sent = [(topics[1], t, others.array([others.follow(t, k, 0.0) for k in (0, 1)])) for t in np.arange(0, 6, 0.01)]
    return [*sent, *((topics[0], t, m) for _, t, m in others.states(names))]


def one_file(folder, messages):
    """Move the MCAP file of a bag, by itself."""
    made = others.bag(folder.with_suffix(".bag"), messages)
    next(made.glob("*.mcap")).rename(folder)


@pytest.fixture
def files(tmp_path):
    """Writes the file of this name."""

    def long(path):
        rows = [(t, j, Q[j][k], LATE[j][k]) for k, t in enumerate(T) for j in Q]
        lines(path, ("time", "joint", "goal_position", "present_position"), zip(*rows, strict=True))

    def dates(path):
        comma = lambda x: f"{x:.6f}".replace(".", ",")  # noqa: E731
        when = [f"2026-03-03T17:37:{10 + t:09.6f}Z" for t in T]
        lines(path, ("timestamp", "command.elbow", "position.elbow"), (when, Q["elbow"], LATE["elbow"]), ";", comma)

    def controller(path):
        names = [f"{role}.positions[{k}]" for role in ("desired", "actual") for k in (0, 1)]
        lines(path, ("time", *names), [T, *Q.values(), *LATE.values()])

    def runs(path):
        plain(tmp_path / "runs" / "a.csv")
        plain(tmp_path / "runs" / "b.csv")

    def rig(path):
        body = '<body><joint name="{}" axis="0 1 0" range="-1 2"/><geom size=".01"/></body>'
        inside = "".join(map(body.format, Q))
        path.write_text(f"<mujoco><compiler angle='radian'/><worldbody>{inside}</worldbody></mujoco>")

    def arrays(path):
        np.savez(path, command=np.stack(list(Q.values()), 1), position=np.stack(list(LATE.values()), 1),
                 joint_names=list(Q))  # fmt: skip

    def json_lines(path):
        rows = zip(T.tolist(), Q["elbow"].tolist(), LATE["elbow"].tolist(), strict=True)
        path.write_text("".join(json.dumps({"time": t, "goal": c, "elbow": {"pos": q}}) + "\n" for t, c, q in rows))

    def aloha(path):
        import h5py

        with h5py.File(path, "w") as file:
            file["action"], file["observations/qpos"] = (np.stack(list(x.values()), 1) for x in (Q, LATE))

    def pace(path):
        import torch

        c, q = (torch.tensor(np.stack(list(x.values()), 1)) for x in (Q, LATE))
        torch.save({"time": torch.tensor(T), "des_dof_pos": c, "dof_pos": q}, path)

    def trajectories(path):
        points = [(a, [others.follow(a, k, 0.0) for k in (0, 1)], []) for a in np.arange(0, 5.9, 0.05)]
        sent = ("/hand/joint_trajectory", 0.0, others.trajectory(others.START, list(Q), points))
        one_file(path, [sent, *(("/hand/state", t, m) for _, t, m in others.states(tuple(Q)))])

    def states_of_a_controller(path):
        fields = ("reference", "feedback", "error", "output")
        own, sent = others.controllers(fields), []
        for t in np.arange(0, 6, 0.02):
            q = [others.follow(t, k) for k in (0, 1)]
            values = dict(zip(fields, ([others.follow(t, k, 0.0) for k in (0, 1)], q, [], []), strict=True))
            sent.append(("/arm_controller/controller_state", t, others.controller_state(own, t, Q, values)))
        others.bag(path, sent, store=own)

    return {
        "controller_run": states_of_a_controller,
        "rosbag2_run": lambda p: others.bag(p, moved(TOPICS), others.StoragePlugin.SQLITE3),
        "run.mcap": trajectories,
        "array.mcap": lambda p: one_file(p, moved(TOPICS)),
        "run.csv": lambda p: plain(p, np.degrees),
        "plain.csv": plain,
        "dates.csv": dates,
        "lab.csv": lambda p: lines(p, ("clock", "soll", "ist"), (T, Q["elbow"], LATE["elbow"])),
        "controller.csv": controller,
        "long.csv": long,
        "ticks.csv": lambda p: plain(p, lambda q: np.round(2048 + q * 4096 / (2 * np.pi))),
        "registers.csv": lambda p: plain(p, lambda q: np.round(1000 * (1.47 - q) / 1.47)),
        "own_numbers.csv": lambda p: plain(p, lambda q: np.round(1000 * (q + 1) / 3)),
        "percent.csv": lambda p: plain(p, lambda q: 100 * (q + 1) / 3),
        "rig.xml": rig,
        "log.jsonl": json_lines,
        "arrays.npz": arrays,
        "so100": lambda p: test_readers.lerobot(p, "v3.0"),
        "hands.zarr": lambda p: test_readers.hands(p, 3),
        "episode_0.hdf5": aloha,
        "chirp.pt": pace,
        "runs": runs,
    }


@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_of_the_page_reads_a_file_of_its_kind(tmp_path, monkeypatch, capsys, files, line):
    monkeypatch.chdir(tmp_path)
    words = shlex.split(line)[1:]
    for name, make in files.items():
        if any(re.split(r"[#/]", w.partition("=")[2] if w.startswith("model=") else w)[0] == name for w in words):
            make(tmp_path / name)
    status = cli.main(words)
    said = capsys.readouterr().out
    assert status == 0, said
    if words[0] == "audit":
        (after,) = [x for x in said.splitlines() if x.startswith("next: ")]
        assert all(w in shlex.split(after) for w in words[2:] if not w.startswith("out="))
        assert "converted" in said or "units.position" not in line
        spans = [float(x.split()[4]) for x in said.splitlines() if re.match(r"  (shoulder|elbow|joint\d|\w*_\d) ", x)]
        assert spans and max(spans) < 1.2 and min(spans) > 0.2, said  # rad, whatever it was written in
    else:
        out = tmp_path / next(w for w in words if w.startswith("out=")).removeprefix("out=")
        assert out.exists()


def test_the_page_has_a_line_for_each_kind(files):
    assert len(COMMANDS) >= 19
    named = {re.split(r"[#/ ]", shlex.split(c)[2])[0] for c in COMMANDS} | {"rig.xml"}
    assert set(files) <= named
