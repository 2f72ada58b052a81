"""What an audit says of several recordings together: what a diagnosis could tell from them, and what to run next."""

from __future__ import annotations

import shlex

import numpy as np

from dexsim.gap import command
from dexsim.gap.audit import main

T = np.arange(0, 6, 0.001)


def written(path, commands, seed, off=0.0, renewed=0):
    """Two joints that follow with a lag of 40 ms; `off` rad that joint b is elsewhere from 3 s on; renewed: samples for
    which joint a's position stays."""
    rng = np.random.default_rng(seed)
    q = {j: np.interp(T - 0.04, T, c) + 2e-4 * rng.standard_normal(len(T)) for j, c in commands.items()}
    q["b"] += off * (T > 3)
    if renewed:
        q["a"] = q["a"][np.arange(len(T)) // renewed * renewed]
    names = ["time", *(f"command.{j}" for j in commands), *(f"position.{j}" for j in q)]
    rows = zip(T, *commands.values(), *q.values(), strict=True)
    path.write_text("\n".join([",".join(names), *(",".join(f"{x:.7g}" for x in r) for r in rows)]) + "\n")
    return path


def motion(kind):
    return {j: 0.4 * np.sin((1.5 + kind + 0.4 * k) * T + k) for k, j in enumerate("ab")}


def test_repeats_that_disagree_are_named_by_motion_and_joint(tmp_path, capsys):
    for kind in (0, 1):
        for again in (0, 1):
            off = 0.03 * (kind == 1 and again == 1)
            written(tmp_path / f"m{kind}_{again}.csv", motion(kind), 10 * kind + again, off)
    assert main([f"{tmp_path}/*.csv"]) == 0
    said = capsys.readouterr().out
    lines = [line for line in said.splitlines() if "repeats_disagree" in line]
    assert len(lines) == 1 and " b: 2 recordings" in lines[0] and "m1_0.csv, m1_1.csv" in lines[0]
    rows = [line.split() for line in said.splitlines() if line.strip().startswith(("m0_0.csv, m0", "m1_0.csv, m1"))]
    apart = {(r[0], r[2]): float(r[3]) for r in rows}
    assert apart["m0_0.csv,", "a"] < 0.4 and apart["m0_0.csv,", "b"] < 0.4 and apart["m1_0.csv,", "a"] < 0.4
    assert 12 < apart["m1_0.csv,", "b"] < 18  # 30 mrad over half of the time, by the square root of two


def test_a_position_that_is_renewed_seldom_is_said_and_the_next_command_is_complete(tmp_path, capsys):
    path = written(tmp_path / "slow log.csv", motion(0), 0, renewed=15)
    (tmp_path / "rig.xml").write_text("<mujoco><worldbody>" + "".join(
        f'<body><joint name="{j}" axis="0 1 0"/><geom size=".01"/></body>' for j in "ab") + "</worldbody></mujoco>")
    (tmp_path / "rig.yaml").write_text("joints: {'*': {kp: 2.0}}\n")
    options = [f"model={tmp_path / 'rig.xml'}", f"servo={tmp_path / 'rig.yaml'}", "units.position=rad"]
    assert main([str(path), *options]) == 0
    said = capsys.readouterr().out
    assert any("stale" in line and "a is read every 15 ms only" in line for line in said.splitlines())
    row = next(line.split() for line in said.splitlines() if line.strip().startswith("a ") and "(logged" in line)
    assert row[1] == "15"
    (line,) = [x for x in said.splitlines() if x.startswith("next: ")]
    words = shlex.split(line.removeprefix("next: "))
    assert words[:2] == ["dexsim", "diagnose"]
    given = command.parse(words[2:])
    assert given["recordings"] == [str(path)] and given["meta"] == {"units.position": "rad"}
    assert command.settings_of(given, tmp_path / "out", "cpu").recordings == [path]


def test_what_a_log_cannot_tell_is_said(tmp_path, capsys):
    still = {"a": np.zeros(len(T)), "b": 0.05 * T}
    main([str(written(tmp_path / "ramp.csv", still, 0))])
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line.startswith(("  a ", "  b "))}
    assert "hardly moves" in rows["a"] and "friction, play" in rows["b"] and "delay, lag" in rows["b"]
