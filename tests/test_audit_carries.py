"""What an audit says of several recordings together: what a diagnosis could tell from them, and what to run next."""

from __future__ import annotations

import dataclasses
import shlex
import subprocess
import sys

import mujoco
import numpy as np
import pytest
import test_gap

from dexsim.actuator.table import ServoTable
from dexsim.cli import main as cli
from dexsim.errors import UserError
from dexsim.gap import command
from dexsim.gap.audit import main, renewed
from dexsim.gap.plant import information
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import INDEX
from dexsim.gap.read import Run, agreement, inputs
from dexsim.recording.mechanism import mechanism

T = np.arange(0, 6, 0.001)


def written(path, commands, seed, off=0.0, renewed=0):
    """Write a CSV file of two joints that follow with a lag of 40 ms; `off` rad that joint b is elsewhere from 3 s on;
    renewed: samples for which joint a's position stays."""
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
    distance = {(r[0], r[2]): float(r[3]) for r in rows}
    assert distance["m0_0.csv,", "a"] < 0.4 and distance["m0_0.csv,", "b"] < 0.4 and distance["m1_0.csv,", "a"] < 0.4
    assert 12 < distance["m1_0.csv,", "b"] < 18  # 30 mrad over half of the time, by the square root of two


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


RIG = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="a" axis="0 1 0" armature="2e-3"/>
<geom size=".02" pos="0 0 -.1" mass=".1" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
BELIEF = {"kp": 2.0, "kd": 0.05, "torque_limit": 1.0, "no_load_speed": 8.0, "coulomb_friction": 0.01}


def made_run(name="run", sent=None, lag=0.04, scale=1.0, seed=0, effort=0.0):
    """Return a run of joint a that follows with a lag and a scale; effort: N.m a rad of target minus position."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 6, 0.01)
    c = 0.4 * np.sin(2 * t) + 0.2 * np.sin(5.3 * t + seed) if sent is None else sent
    q = scale * np.interp(t - lag, t, c) + 2e-4 * rng.standard_normal(len(t))
    run = Run(name, ("a",), t, c[:, None], t, q[:, None], ServoTable.from_dict({"joints": {"*": BELIEF}}),
              np.array([0, 0, -9.81]))  # fmt: skip
    if effort:
        run.torque = (effort * (c - q))[:, None]
    return run


def test_what_holds_of_a_machine_is_judged_over_all_of_its_recordings():
    usual = [made_run(f"r{k}", seed=k, lag=0.04 + 0.004 * k, effort=2.0) for k in range(4)]
    assert agreement.contradictions(usual, "a") == []
    for odd, kind, words in (
        (made_run("odd", seed=9, lag=0.16, effort=2.0), "clock_skew", "160 ms late here and 35 to 50 ms"),
        (made_run("odd", seed=9, lag=-0.1, effort=2.0), "clock_skew", "-100 ms late here"),
        (made_run("odd", seed=9, effort=-2.0), "sign_mismatch", "the other way in 4 other recordings"),
        (made_run("odd", seed=9, effort=2000.0), "unit", "1e+03 times as large or small as in 4 other recordings"),
        (made_run("odd", seed=9, scale=57.3), "unit", "57.3 x as far"),
    ):
        found = agreement.contradictions([*usual, odd], "a")
        assert {f[0] for f in found} == {"odd"} and any(f[1] == kind and words in f[2] for f in found), found
    pair = agreement.contradictions([made_run("x", lag=0.02), made_run("y", lag=0.2, seed=3)], "a")
    assert {f[0] for f in pair} == {"x", "y"}  # which of two is wrong does not show


def test_a_narrow_band_tells_no_lag():
    """A sine repeats: its lag is known up to a period only."""
    t = np.arange(0, 6, 0.01)
    assert agreement.seen(made_run(sent=0.4 * np.sin(2 * np.pi * 4 * t)), 0).lag is None
    wide = agreement.seen(made_run(sent=0.4 * np.sin(2 * t) + 0.2 * np.sin(5.3 * t)), 0)
    assert wide.lag == pytest.approx(0.0375, abs=0.003)


def test_the_stages_of_a_drive_have_their_delays_and_their_order():
    t = np.arange(0, 8, 0.005)
    rng = np.random.default_rng(0)
    c = np.repeat(rng.uniform(-0.5, 0.5, 40), 40)
    late = lambda x, d: np.interp(t - d, t, x)  # noqa: E731
    q, v = np.zeros(len(t)), np.zeros(len(t))
    for k in range(1, len(t)):
        v[k] = v[k - 1] + 0.005 * (late_target(c, t, k, 0.02) - q[k - 1] - 0.05 * v[k - 1]) * 150
        q[k] = q[k - 1] + 0.005 * v[k]
    duty = late(c, 0.02) - q
    run = Run("r", ("a",), t, c[:, None], t, q[:, None], ServoTable.from_dict({"joints": {"*": BELIEF}}),
              np.array([0, 0, -9.81]))  # fmt: skip
    run.duty, run.torque = duty[:, None], late(duty, 0.01)[:, None]
    delays = {(s.before, s.after): s.delay for s in agreement.stages([run], "a")}
    assert list(delays) == [("target", "duty"), ("duty", "effort"), ("effort", "motion")]
    assert delays["target", "duty"] == pytest.approx(0.02, abs=0.004)
    assert delays["duty", "effort"] == pytest.approx(0.01, abs=0.004)
    run.torque = late(duty, -0.012)[:, None]  # logged before what it follows
    assert agreement.stages([run], "a")[1].delay == pytest.approx(-0.012, abs=0.004)
    run.duty = run.torque = None
    assert agreement.stages([run], "a") == []


def late_target(c, t, k, delay):
    return c[max(k - round(delay / (t[1] - t[0])), 0)]


def precisions(sent, seed=0):
    model = mujoco.MjModel.from_xml_string(RIG)
    return {x.figure.words: x for x in information.informed(build(model, [made_run(sent=sent, seed=seed)])[0])}


def test_a_motion_tells_only_what_it_excites():
    """A slow sine says nothing of the limits; steps at full speed do; a joint at rest nothing of what moves."""
    t = np.arange(0, 6, 0.01)
    slow, fast = precisions(0.4 * np.sin(2 * t)), precisions(0.9 * np.sign(np.sin(3 * t)))
    assert not slow["torque limit"].possible and not slow["no-load speed"].possible and slow["stiffness"].possible
    assert fast["no-load speed"].possible and fast["torque limit"].steps < slow["torque limit"].steps
    rest = precisions(0 * t)
    assert not any(rest[w].possible for w in ("damping", "inertia", "viscous friction", "no-load speed", "play"))
    assert slow["viscous friction"].beside is not None and slow["viscous friction"].beside.words == "damping"
    how = dict(information.advice(list(slow.values())))
    assert "limit" in how["torque limit"] and "drive off" in how["viscous friction"]


def test_more_of_the_same_motion_tells_more():
    t = np.arange(0, 6, 0.01)
    sent = 0.4 * np.sin(2 * t) + 0.2 * np.sin(5.3 * t)
    model = mujoco.MjModel.from_xml_string(RIG)
    one, four = (information.informed(build(model, [made_run(f"r{k}", sent, seed=k) for k in range(n)])[0])
                 for n in (1, 4))  # fmt: skip
    for a, b in zip(one, four, strict=True):
        if a.possible:
            assert b.steps == pytest.approx(a.steps / 2, rel=0.3)


@pytest.mark.slow
def test_the_predicted_precision_holds_over_repeats():
    """Fits of every figure that is told, to recordings that differ by their noise alone, scatter by less than was
    predicted for each (one reading in a tenth of a second counts, of ten) and by no less than a tenth of that."""
    clean = [test_gap.plant_run(f"r{k}", k, 6.0, {}, seed=k, noisy=False) for k in (0, 1, 3)]
    rng, fits, noise = np.random.default_rng(48), [], 4e-4
    for _ in range(6):
        runs = [dataclasses.replace(r, q=r.q + rng.normal(0, noise, r.q.shape), qs=None, noises=None) for r in clean]
        for r in runs:
            r.smooth()
        case = build(test_gap.model(), runs)[0]
        stated = [x for x in information.informed(case) if x.possible and x.figure.column != "backlash"]
        plant, x = case.plant, np.zeros(len(stated))
        base, windows = plant.base(), plant.windows(information.WINDOW)
        change = [t.figure.step * base[..., INDEX[t.figure.column]] if t.figure.relative
                  else information.own_step(t.figure, case) for t in stated]  # fmt: skip

        def row(x, stated=stated, base=base, change=change):
            out = base.copy()
            for t, by, share in zip(stated, change, x, strict=True):
                out[..., INDEX[t.figure.column]] += share * by
            return out

        for _ in range(6):  # Gauss and Newton
            q = plant.simulate(np.array([row(x), *(row(x + 0.2 * e) for e in np.eye(len(x)))]), windows)[0]
            J, miss = (q[1:] - q[0]).T / 0.2, plant.q[windows.sample_row] - q[0]
            x = x + np.linalg.lstsq(J - J.mean(0), miss - miss.mean(), rcond=None)[0]
        fits.append(x)
    spread, predicted = np.std(fits, 0, ddof=1), np.array([t.steps for t in stated])
    names = {t.figure.words for t in stated}
    assert {"stiffness", "inertia", "dry friction", "delay"} <= names and "viscous friction" not in names
    assert (spread < predicted).all() and (spread > 0.1 * predicted).all(), (names, predicted / spread)


def test_the_audit_prints_stages_figures_and_what_to_record(tmp_path, capsys):
    run = made_run()
    names = "time,command.a,position.a,effort.a"
    rows = np.stack([run.t, run.cmd[:, 0], run.q[:, 0], 2.0 * (run.cmd[:, 0] - run.q[:, 0])], 1)
    np.savetxt(tmp_path / "r.csv", rows, delimiter=",", header=names, comments="")
    (tmp_path / "rig.xml").write_text(RIG)
    (tmp_path / "rig.yaml").write_text(str({"joints": {"*": BELIEF}}))
    main([str(tmp_path / "r.csv"), f"model={tmp_path / 'rig.xml'}", f"servo={tmp_path / 'rig.yaml'}"])
    said = capsys.readouterr().out
    assert "stages of the drives" in said and "target -> effort" in said
    assert "figures of the believed drives that a fit could tell" in said and "of 9 " in said
    assert "for the others record" in said and "torque limit of all joints: steps so large" in said


@pytest.mark.slow
def test_from_a_bare_log_to_a_diagnosis(tmp_path, monkeypatch, capsys):
    """Where neither a model nor a servo is there, the audit writes both to begin with, and its last line is a diagnosis
    that has all that it needs."""
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "bare.csv", motion(0), 0)
    assert main(["bare.csv"]) == 0
    assert "model=MODEL.xml servo=SERVO.yaml" in capsys.readouterr().out
    assert main(["bare.csv", "out=mine"]) == 0
    (line,) = [x for x in capsys.readouterr().out.splitlines() if x.startswith("next: ")]
    words = shlex.split(line.removeprefix("next: dexsim diagnose "))
    settings = command.settings_of(command.parse(words), tmp_path / "out", "cpu")
    m = mechanism(settings.model, settings.servo)
    assert m.joints == ("a", "b") and len(inputs.files(settings.recordings, "recordings")) == 1
    with pytest.raises(UserError, match=r"model.xml exists"):
        main(["bare.csv", "out=mine"])
    assert main(["bare.csv", "model=mine/model.xml", "servo=mine/servo.yaml"]) == 0  # which the audit reads, too
    assert "figures of the believed drives" in capsys.readouterr().out


def test_the_xhands_recording_needs_no_model(tmp_path, capsys):
    path = tmp_path / "xhand.csv"
    path.write_text(written(path, motion(0), 0).read_text().replace(".a", ".index_joint1").replace(".b", ".mid_joint1"))
    main([str(path)])
    said = capsys.readouterr().out
    assert f"next: dexsim diagnose recordings={path} out=out/diagnosis" in said
    assert "stamped late alike in all files" in said


def test_the_true_rate_of_each_signal_is_said(tmp_path, capsys):
    """A firmware that renews its position every 20 ms with jitter, a policy of 20 Hz and a current of 50 Hz in a log of
    200 Hz; what creeps over a coarse encoder's steps is not slow."""
    rng = np.random.default_rng(0)
    t = np.cumsum(0.005 + 0.001 * rng.random(800))
    at = lambda period, x: x(np.floor(t / period) * period)  # noqa: E731
    motion_ = lambda u: 0.5 * np.sin(2 * u)  # noqa: E731
    printed = at(0.02, lambda u: np.round(motion_(u - 0.05) / 1.5e-3) * 1.5e-3)
    sent, effort = at(0.05, motion_), at(0.02, lambda u: motion_(u) - motion_(u - 0.05))
    head = "time,command.a,position.a,effort.a"
    np.savetxt(tmp_path / "r.csv", np.stack([t, sent, printed, effort], 1), delimiter=",", header=head, comments="")
    main([str(tmp_path / "r.csv")])
    said = capsys.readouterr().out
    lines_ = [x for x in said.splitlines() if "a new value" in x]
    found = {x.split(" of ")[0]: float(x.split("every ")[1].split()[0]) for x in lines_}
    assert found["position"] == pytest.approx(20, abs=2) and found["effort"] == pytest.approx(20, abs=2)
    assert found["command"] == pytest.approx(50, abs=3)
    assert renewed(t, np.round(0.02 * t / 1.5e-3) * 1.5e-3) == 0.0 and renewed(t, motion_(t)) == 0.0


@pytest.mark.slow
def test_the_diagnosis_that_the_audit_ends_with_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "bare.csv", motion(0), 0)
    main(["bare.csv", "out=mine"])
    (line,) = [x for x in capsys.readouterr().out.splitlines() if x.startswith("next: ")]
    words = shlex.split(line.removeprefix("next: dexsim "))
    assert cli.main([*words, "limit=5", "replay=none"]) == 0
    assert (tmp_path / "out" / "diagnosis" / "diagnosis.json").exists()


def test_an_audit_begins_without_torch_and_warp():
    """They take two seconds to import, which reading a recording has no use for."""
    code = "import dexsim.gap.audit, sys; print({'torch', 'warp', 'scipy.interpolate'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
