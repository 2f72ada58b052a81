"""train.py and play.py as a user runs them, on a tiny task: what they print, write and answer to bad input."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import dummy_task
import pytest
import shell
import torch
import yaml

from dexsim.cli import checks, console, folder, machine, settings, train
from dexsim.console import tables
from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.paths import CONFIGS
from dexsim.version import VERSION

torch.set_num_threads(1)
QUICK = ("task=dummy", "device=cpu", "worlds=4", "iterations=2", "final_episodes=0",
         "agent.actor.hidden_dims=[8]", "agent.critic.hidden_dims=[8]")


@pytest.fixture(scope="module")
def configs(tmp_path_factory):
    return shell.configs(tmp_path_factory.mktemp("shell"))


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def run_folder(configs, tmp_path_factory):
    """Return one finished run."""
    where = tmp_path_factory.mktemp("runs") / "done"
    assert shell.call("train", configs, *QUICK, f"out={where}", "save_interval=1") == 0
    return where


def refused(capfd, configs, *argv, script="train"):
    """Return the one line on stderr of a refused command; it exits with 2 and never shows a traceback."""
    capfd.readouterr()
    assert shell.call(script, configs, *argv) == 2
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err and err.count("\n") == 1 and err.startswith("error: "), err
    return err


# --- what a good run leaves and says

def test_a_run_from_start_to_play_command(configs, place, capfd):
    assert shell.call("train", configs, *QUICK, "run=first", "save_interval=1") == 0
    out = capfd.readouterr().out
    where = place / "runs" / "dummy" / "first"
    for part in (
        f"dexsim {VERSION}",
        "torch ",
        "warp-lang 1.19",
        "mujoco 4.0",
        "rsl-rl-lib 5.5",
        "device",
        "memory",
        "4 worlds",
        "compiling kernels (first run only; cached afterwards)",
        "observations of the actor (2)",
        "rewards (1)",
        "randomization (1)",
        "2/2",
        "steps/s",
        " left",
        "play it:  dexsim play checkpoint=runs/dummy/first/policy.pt",
    ):
        assert part in out, part
    assert "Actor Model" not in out and "Learning iteration" not in out  # rsl-rl's own printing
    names = {p.name for p in where.iterdir()}
    assert {"config.yaml", "progress.csv", "curves.png", "last.pt", "model_1.pt", "model_2.pt", "policy.pt"} <= names
    assert any(n.startswith("events.out.tfevents") for n in names) and not any("tmp" in n for n in names)
    cfg = yaml.safe_load((where / "config.yaml").read_text())
    assert cfg == checkpoint.load(where / "last.pt")["config"]
    assert cfg["choices"]["task"] == "dummy" and cfg["device"] == "cpu"
    rows = (where / "progress.csv").read_text().splitlines()
    assert len(rows) == 3 and "reward/near" in rows[0]
    assert (where / "curves.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_final_episodes_with_video_or_a_reason(configs, place, capfd):
    assert shell.call("train", configs, *QUICK, "run=a", "final_episodes=4") == 0
    out = capfd.readouterr().out
    assert json.loads(Path("runs/dummy/a/play/metrics.json").read_text())["episodes"] == 4
    assert ("video    runs" in out) != ("no video: no OpenGL" in out)


def test_a_training_stands_beside_others():
    cfg = {"task": {"expect": {"of": "ten", "hold_rate": [0.95, 0.96, 0.97], "of_another_version": [1, 2, 3]}}}
    assert train.beside(cfg, {"hold_rate": 0.9, "other": 1.0}) == [("hold_rate", 0.9, 0.95, 0.96, 0.97)]
    assert train.beside({"task": {}}, {"hold_rate": 0.9}) == []


def test_nameless_runs_do_not_collide(configs, place):
    cfg = {"out": None, "run": None, "choices": {"task": "dummy"}}
    made = [folder.for_run(cfg) for _ in range(3)]
    assert len(set(made)) == 3


def test_resume_continues_counters_curves_and_config(configs, place, run_folder, capfd):
    assert shell.call("train", configs, f"resume={run_folder / 'last.pt'}", "iterations=4", "run=more") == 0
    data = checkpoint.load("runs/dummy/more/last.pt")
    assert data["iteration"] == 4 and data["steps"] == 4 * 24 * 4
    assert data["config"]["agent"]["actor"]["hidden_dims"] == [8] and data["config"]["worlds"] == 4
    assert data["env"]["count"] == 1 + 4 * 24  # the first step only compiles
    rows = Path("runs/dummy/more/progress.csv").read_text().splitlines()
    assert [r.split(",")[0] for r in rows] == ["iteration", "1", "2", "3", "4"]
    assert "after 2 iterations" in capfd.readouterr().out


def test_resume_takes_overrides_of_groups_and_values(configs, place, run_folder):
    from dexsim.cli.start import for_train

    ready = for_train([f"resume={run_folder / 'last.pt'}", "servo=ideal", "save_interval=7", "iterations=9"], configs)
    assert ready.cfg["choices"]["servo"] == "ideal" and ready.cfg["save_interval"] == 7
    assert ready.cfg["servo"] == yaml.safe_load((configs / "servo" / "ideal.yaml").read_text())
    assert ready.cfg["run"] is None and ready.cfg["task"]["name"] == "dummy"


def test_play_from_a_checkpoint(configs, place, run_folder, capfd):
    assert shell.call("play", configs, f"checkpoint={run_folder / 'policy.pt'}", "episodes=6", "video=false", "out=o",
                      "device=cpu", "task.steps=9") == 0
    metrics = json.loads(Path("o/metrics.json").read_text())
    assert metrics["graph"] is False  # no autograd graph reached the environment
    assert metrics["episodes"] == 6 and metrics["nothing"] is None  # NaN is no JSON
    assert metrics["about"]["iteration"] == 2 and metrics["about"]["seed"] == 0
    out = capfd.readouterr().out
    assert "mean_return" in out and "by world" in out and "progress_plot.png" in out and "6 worlds" in out
    assert "policy   iteration 2, " in out and "trained at commit " in out
    assert not Path("o/video.mp4").exists() and Path("o/progress_plot.png").exists()


@pytest.mark.parametrize("policy", ["random", "zero", "scripted"])
def test_play_without_a_checkpoint(configs, place, policy):
    assert shell.call("play", configs, f"policy={policy}", "task=dummy", "episodes=4", "video=false", "device=cpu") == 0
    metrics = json.loads(Path(f"out/dummy_{policy}/metrics.json").read_text())
    assert metrics["about"]["policy"] == policy


def test_presets_give_way_to_the_user(configs):
    from dexsim.cli.start import for_train

    plain = for_train(["task=dummy", "device=cpu"], configs).cfg
    assert (plain["worlds"], plain["iterations"], plain["task"]["nested"]["high"]) == (4, 2, 3.0)
    own = for_train(["task=dummy", "device=cpu", "worlds=6", "task.nested.high=9"], configs).cfg
    assert (own["worlds"], own["iterations"], own["task"]["nested"]["high"]) == (6, 2, 9)
    off = for_train(["task=dummy", "device=cpu", "preset=none"], configs).cfg
    assert (off["worlds"], off["task"]["nested"]["high"]) == (64, 2.0)


def test_servo_file_goes_into_the_config(configs, place):
    from dexsim.cli.start import for_train

    table = yaml.safe_load((configs / "servo" / "ideal.yaml").read_text())
    Path("mine.yaml").write_text(yaml.safe_dump(table))
    cfg = for_train(["task=dummy", "device=cpu", "servo_file=mine.yaml"], configs).cfg
    assert cfg["servo"] == table and cfg["choices"]["servo"] == "mine.yaml"


# --- help

@pytest.mark.parametrize("name", ["train", "play"])
def test_help_names_settings_and_groups_and_is_quick(name):
    before = os.times()
    done = subprocess.run([sys.executable, f"{name}.py", "--help"], cwd=shell.ROOT, capture_output=True, text=True)
    after = os.times()
    assert done.returncode == 0 and done.stderr == ""
    assert "device=null" in done.stdout and "agent=" in done.stdout and "worlds" in done.stdout
    assert ("checkpoint=" if name == "play" else "resume=") in done.stdout
    assert after.children_user + after.children_system - before.children_user - before.children_system < 10  # CPU


def test_cfg_prints_the_settings_and_does_nothing(configs, place, capfd):
    assert shell.call("train", configs, *QUICK, "--cfg", "seed=5") == 0
    assert yaml.safe_load(capfd.readouterr().out)["seed"] == 5 and not Path("runs").exists()


# --- bad input

@pytest.mark.parametrize("argument, words", [
    ("wrlds=4", "unknown setting 'wrlds' (did you mean worlds?); the settings are: agent, "),
    ("agent.algorithm.learning_rat=1", "did you mean agent.algorithm.learning_rate?); agent.algorithm has: "),
    ("learning_rate=1", "did you mean agent.algorithm.learning_rate?"),
    ("sim.engin.x=1", "unknown setting 'sim.engin.x'"),
    ("worlds.x=1", "worlds is a single value"),
    ("task=gras", "task=gras: no such task; task can be grasp, rotate"),
    ("task=gras", "did you mean grasp?"),
    ("servo=my.yaml", "servo_file=my.yaml"),
    ("servo_file=none.yaml", "none.yaml"),
    ("--worlds=4", "write worlds=4"),
    ("-x", "key=value"),
    ("worlds", "key=value"),
    ("worlds=[1", "cannot read 'worlds=[1'"),
    ("worlds=1,2", "several values"),
    ("worlds=many", "worlds=many: must be a"),
    ("worlds=0", "worlds=0: must be a whole number from 1"),
    ("worlds=2.5", "worlds=2.5: must be a whole number"),
    ("seed=-1", "seed=-1"),
    ("seed=abc", "seed=abc: must be a number"),
    (f"seed={'9' * 400}", "seed: its value (a whole number of more than 64 bits)"),
    ("seed=${seed}", "seed=${seed}: Recursive interpolation"),
    ("sim=5", "sim is a group of settings (sim.engine"),
    ("+sim=5", "+sim: is there already, a group of settings (sim.engine"),
    ("+task=true", "+task: is there already"),
    ("++task={a: 1}", "+task: is there already"),
    ("+sim.timestep=x", "sim.timestep=x: must be a number"),
    ("sim.deterministic=3", "must be true or false"),
    ("sim.timestep=0", "sim.timestep=0: must be a number from"),
    ("sim.timestep=-0.1", "sim.timestep=-0.1"),
    ("sim.control_period=0.012", "sim.control_period=0.012: must be a multiple of sim.timestep=0.007, e.g. 0.014"),
    ("sim.control_period=0.001", "must be a multiple of sim.timestep=0.007, e.g. 0.007"),
    ("save_interval=1.5", "save_interval=1.5: must be a whole number"),
    ("choices.task=x", "a record of the groups chosen"),
    ("agent.algorithm.gamma=2", "agent.algorithm.gamma=2: must be a number from 0 to 1"),
    ("agent.algorithm.learning_rate=nan", "learning_rate"),
    ("agent.actor.hidden_dims=[0]", "hidden_dims"),
    ("agent.algorithm.num_mini_batches=1000", "too few samples"),
    ("+agent.algorithm.nonsense=1", "nonsense"),
    ("device=gpu", "device=gpu: must be cpu, cuda or cuda:<number>"),
    ("device=cuda:99", "device=cuda:99"),
    ("preset=big", "preset=big: no such preset; this task has auto, none, cpu"),
    ("resume=lost.pt", "lost.pt: no such checkpoint"),
    ("~sim.nothing", "unknown setting 'sim.nothing'"),
])
def test_bad_argument_is_one_line(configs, place, capfd, argument, words):
    quick = [q for q in QUICK if q.partition("=")[0] != argument.partition("=")[0]]
    assert words in refused(capfd, configs, *quick, argument)
    assert not Path("runs").exists() or argument.startswith("+")  # nothing left behind


@pytest.mark.parametrize("argv, words", [
    ((), "say what to play"),
    (("task=dummy",), "say what to play"),
    (("policy=best", "task=dummy"), "policy=best: must be random, zero or scripted"),
    (("policy=zero", "checkpoint=x.pt"), "say what to play"),
    (("checkpoint=lost.pt",), "lost.pt: no such checkpoint"),
    (("policy=zero", "task=dummy", "episodes=0"), "episodes=0"),
    (("policy=zero", "task=dummy", "video=maybe"), "video=maybe: must be true or false"),
    (("policy=zero", "task=dummy", "episods=3"), "unknown setting 'episods'"),
])
def test_bad_play_argument_is_one_line(configs, place, capfd, argv, words):
    assert words in refused(capfd, configs, *argv, script="play")


def test_values_that_may_take_another_shape(configs):
    from dexsim.cli.start import for_train

    cfg = for_train(
        [
            "task=dummy",
            "device=cpu",
            "task.sizes=[3.0]",
            "task.mass=[0.1,0.2]",
            "task.steps=30",
            "+task.new=1",
            "~task.flag",
        ],
        configs,
    ).cfg["task"]
    assert (cfg["sizes"], cfg["mass"], cfg["steps"], cfg["new"]) == ([3.0], [0.1, 0.2], 30, 1) and "flag" not in cfg


def test_bad_checkpoints_are_one_line(configs, place, capfd, run_folder):
    good = (run_folder / "last.pt").read_bytes()
    Path("short.pt").write_bytes(good[: len(good) // 2])
    data = torch.load(run_folder / "last.pt", weights_only=True)
    torch.save(data | {"version": 99}, "new.pt")
    torch.save({"code": subprocess.Popen}, "code.pt")
    for file, words in (("short.pt", "truncated"), ("new.pt", "format version 99"), ("code.pt", "refused")):
        assert words in refused(capfd, configs, f"checkpoint={file}", script="play")
        assert words in refused(capfd, configs, f"resume={file}")
    assert "only a policy" in refused(capfd, configs, f"resume={run_folder / 'policy.pt'}", "iterations=9")
    assert "all 2 iterations are done" in refused(capfd, configs, f"resume={run_folder / 'last.pt'}")


def test_changed_observations_are_named(configs, place, capfd, run_folder, monkeypatch):
    describe = dummy_task.DummyEnv.describe
    monkeypatch.setattr(dummy_task.DummyEnv, "describe", lambda self: describe(self) | {
        "observations": {"actor": [("y", 2, "m")], "critic": [("x", 4, "m")]}})
    err = refused(capfd, configs, f"checkpoint={run_folder / 'policy.pt'}", "video=false", "out=o", script="play")
    assert "entry 0 of the actor's was x (2), here it is y (2)" in err


@pytest.mark.parametrize("out", ["file/inside", "/proc/dexsim_run"])
def test_unwritable_run_folder(configs, place, capfd, out):
    Path("file").write_text("")
    assert "cannot write into" in refused(capfd, configs, *QUICK, f"out={out}")
    assert "cannot write into" in refused(capfd, configs, "policy=zero", "task=dummy", f"out={out}", script="play")


def test_a_run_folder_is_never_overwritten(configs, place, capfd, run_folder):
    before = (run_folder / "last.pt").read_bytes()
    assert "already holds a run" in refused(capfd, configs, *QUICK, f"out={run_folder}")
    assert (run_folder / "last.pt").read_bytes() == before


def test_a_run_that_saved_nothing_is_not_one_to_continue(configs, place, capfd):
    Path("began").mkdir()
    Path("began/config.yaml").touch()
    said = refused(capfd, configs, *QUICK, "out=began")
    assert "already holds a run" in said and "resume=" not in said


def test_full_disk_in_training_keeps_the_last_checkpoint(configs, place, capfd, monkeypatch):
    real, saves = os.fsync, []

    def fsync(handle):
        saves.append(handle)
        if len(saves) > 6:  # model_1, last, policy and their folder; then the disk is full
            raise OSError(errno.ENOSPC, "No space left on device")
        real(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    err = refused(capfd, configs, *QUICK, "save_interval=1", "run=full")
    assert "the disk is full" in err
    assert checkpoint.load("runs/dummy/full/last.pt")["iteration"] == 1


def test_full_disk_elsewhere(configs, place, capfd, monkeypatch):
    def add(*_):
        raise OSError(errno.ENOSPC, "No space left on device", "progress.csv")

    monkeypatch.setattr(folder.ProgressFile, "add", add)
    assert "the disk is full at progress.csv" in refused(capfd, configs, *QUICK)


@pytest.mark.parametrize("name", ["a" * 400, "~nobody_of_this_name/run"])
def test_a_path_that_cannot_be_is_one_line(configs, place, capfd, name):
    err = refused(capfd, configs, *QUICK, f'out="{name}"')
    assert "a" * 60 in err and "too long" in err or "no such user" in err


def test_full_memory_is_one_line(configs, place, capfd, monkeypatch):
    def add(*_):
        raise RuntimeError("CUDA out of memory. Tried to allocate 20.00 GiB.")

    monkeypatch.setattr(folder.ProgressFile, "add", add)
    assert "use fewer worlds=" in refused(capfd, configs, *QUICK)


# --- Ctrl-C

@pytest.mark.parametrize("number, status", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_ctrl_c_saves_and_says_where(configs, place, capfd, monkeypatch, number, status):
    step, count = dummy_task.DummyEnv.step, []

    def interrupted(self, actions):
        count.append(1)
        if len(count) == 1 + 24 + 3:
            os.kill(os.getpid(), number)
        return step(self, actions)

    monkeypatch.setattr(dummy_task.DummyEnv, "step", interrupted)
    before = signal.getsignal(number)
    assert shell.call("train", configs, *QUICK, "iterations=50", "run=cut") == status
    out = capfd.readouterr().out
    assert "stopping and saving" in out and "dexsim train resume=runs/dummy/cut/last.pt" in out
    assert checkpoint.load("runs/dummy/cut/last.pt")["iteration"] == 1
    assert Path("runs/dummy/cut/curves.png").exists() and signal.getsignal(number) is before


def test_ctrl_c_while_building(configs, place, capfd, monkeypatch):
    monkeypatch.setattr(dummy_task, "make_env", lambda *a, **k: os.kill(os.getpid(), signal.SIGINT) or time.sleep(5))
    assert shell.call("train", configs, *QUICK) == 130
    assert "before there was anything to save" in capfd.readouterr().err


# --- small parts

def test_tables_and_numbers():
    text = tables.table("t", ("name", "n"), [("a", 1.23456), ("long name", 20.0)])
    assert text.splitlines() == ["t", "  name           n", "  a          1.235", "  long name     20"]
    assert tables.table("t", ("name",), []) == "t\n  name"
    assert [tables.duration(s) for s in (5.4, 187, 3727)] == ["5 s", "3:07", "1:02:07"]
    assert [tables.count(v) for v in (950, 12345, 4.56e6, 1.2e9)] == ["950", "12.3k", "4.56M", "1.2G"]
    assert [tables.cell(v) for v in (True, None, (0, 1.5), [1, 2, 3], "x")] == ["yes", "-", "0 .. 1.5", "1, 2, 3", "x"]


def test_progress_file_gains_columns(tmp_path):
    file = folder.ProgressFile(tmp_path / "p.csv")
    file.add({"iteration": 1, "a": 0.5})
    file.add({"iteration": 2, "a": 0.25, "b": float("nan")})
    file.add({"iteration": 3, "b": 2.0})
    assert (tmp_path / "p.csv").read_text().split() == ["iteration,a,b", "1,0.5,", "2,0.25,", "3,,2.0"]
    again = folder.ProgressFile(tmp_path / "q.csv", tmp_path / "p.csv", until=2)
    again.add({"iteration": 3, "a": 1.0})
    assert (tmp_path / "q.csv").read_text().split() == ["iteration,a", "1,0.5", "2,0.25", "3,1.0"]


def test_lines_show_time_left(monkeypatch, capsys):
    clock = [100.0]
    monkeypatch.setattr(console.time, "perf_counter", lambda: clock[0])
    lines = console.TrainingLines(10, ["reward/near"])
    lines.start(0)
    for it in (1, 2, 3):
        clock[0] += 2.0
        lines.show({"iteration": it, "steps": it * 100, "rate": 50.0, "reward/near": 0.25})
    out = capsys.readouterr().out.splitlines()
    assert len(out) == 3 and out[-1].endswith("14 s left") and "near 0.25" in out[-1] and "reward      -" in out[-1]


def test_device_choice(monkeypatch):
    assert machine.device("cpu") == "cpu"
    monkeypatch.setattr(machine.torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(machine.torch.cuda, "device_count", lambda: 2)
    assert [machine.device(a) for a in (None, "cuda", "cuda:1")] == ["cuda:0", "cuda:0", "cuda:1"]
    with pytest.raises(UserError, match="cuda:0 to cuda:1"):
        machine.device("cuda:2")


def test_limits_name_existing_settings():
    """A limit on a setting that was renamed would check nothing."""
    cfg = yaml.safe_load((CONFIGS / "play.yaml").read_text())
    cfg |= settings.resolve(settings.from_files(CONFIGS, {"task": "grasp"}))
    missing = [k for k in checks.LIMITS if checks.get(cfg, k) is None
               and k.rpartition(".")[2] not in (checks.get(cfg, k.rpartition(".")[0]) if "." in k else cfg)]
    assert not missing


@pytest.mark.parametrize("name", ["config", "play"])
def test_every_setting_has_a_line_in_the_help(name):
    from dexsim.console.program import settings as lines

    path = CONFIGS / f"{name}.yaml"
    content = yaml.safe_load(path.read_text())
    content.pop("defaults", None)
    names = [f"{k}.{i}" for k, v in content.items() if isinstance(v, dict) for i in v]
    names += [k for k, v in content.items() if not isinstance(v, dict)]
    assert sorted(names) == sorted(row[0] for row in lines(path))


def test_the_help_of_play_lists_what_goes_with_a_replay():
    from dexsim.cli import help, recorded

    text = help.text("play", CONFIGS)
    assert [k for k in (*recorded.KEYS, "remap.OURS", "meta.KEY") if f"{k}=" not in text] == []


@pytest.mark.parametrize("line, said", [
    ("+agent.actor.hidden_dims.task=[16,16]", "agent.actor.hidden_dims is a list"),
    ("hand=" + "a" * 300, "must be one of xhand, xhand_skin, or a folder with a hand.yaml"),
])  # fmt: skip
def test_a_name_in_a_list_and_a_name_too_long_for_a_file_are_one_line(line, said, capsys):
    from dexsim.cli.main import main

    assert main(["train", "task=grasp", "device=cpu", "worlds=1", "iterations=1", line]) == 2
    out = "".join(capsys.readouterr())
    assert said in out and "Traceback" not in out
