"""A file of the user's where a command would write: told before the work begins, and left as it is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import shell
import torch
from bundles import make_checkpoint
from recordings import signal

from dexsim import excite, export, import_object
from dexsim.cli import stable_grasps
from dexsim.console.ending import guard
from dexsim.errors import UserError
from dexsim.import_hand import moves
from tools.assets import xhand

torch.set_num_threads(1)
MINE = b"a day's work"
PLAY = ("policy=zero", "task=dummy", "device=cpu", "episodes=2", "video=false")


@pytest.fixture(scope="module")
def configs(tmp_path_factory):
    return shell.configs(tmp_path_factory.mktemp("shell"))


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def bundle_of_zeros(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bundle")
    return export.export(str(make_checkpoint(folder / "policy.pt")), folder / "out", steps=2)


def mine(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(MINE)
    return path


def refused(capfd, status: int, path: Path) -> None:
    """Expect one line that names the file, and the file as it was."""
    err = capfd.readouterr().err.strip()
    assert status == 2 and path.name in err and "would be overwritten" in err and "\n" not in err, err
    assert path.read_bytes() == MINE


def never(*_, **__):
    raise AssertionError("the work has begun")


def test_play(configs, place, capfd, monkeypatch):
    from dexsim.cli import build

    path = mine(place / "o" / "metrics.json")
    with monkeypatch.context() as patch:
        patch.setattr(build, "build_env", never)
        refused(capfd, shell.call("play", configs, *PLAY, "out=o"), path)
        film = mine(place / "film" / "video.mp4")
        refused(capfd, shell.call("play", configs, *PLAY[:-1], "out=film"), film)
    assert shell.call("play", configs, *PLAY, "out=film") == 0 and film.read_bytes() == MINE  # not asked for
    assert shell.call("play", configs, *PLAY, "out=again", "seed=1") == 0
    assert shell.call("play", configs, *PLAY, "out=again", "seed=2") == 0, "its own results are replaced"
    assert json.loads((place / "again" / "metrics.json").read_text())["about"]["seed"] == 2
    assert not [p for p in (place / "again").iterdir() if p.suffix == ".tmp"]


def test_a_plot_that_the_user_drew_again(configs, place, capfd):
    path = mine(place / "o" / "progress_plot.png")
    refused(capfd, shell.call("play", configs, *PLAY, "out=o"), path)
    assert json.loads((place / "o" / "metrics.json").read_text())["episodes"] == 2, "what can be written is there"


def test_half_a_file_is_none(configs, place, monkeypatch, capfd):
    """What fails while the numbers are written leaves those of the last play."""
    assert shell.call("play", configs, *PLAY, "out=o") == 0
    before = (place / "o" / "metrics.json").read_bytes()
    write = Path.write_text

    def full(self, text, *a, **k):
        if self.name == "metrics.json":
            write(self, text[: len(text) // 2], *a, **k)
            raise OSError(28, "No space left on device")
        return write(self, text, *a, **k)

    monkeypatch.setattr(Path, "write_text", full)
    assert shell.call("play", configs, *PLAY, "out=o", "seed=5") == 2
    assert "No space left" in capfd.readouterr().err and (place / "o" / "metrics.json").read_bytes() == before


@pytest.mark.parametrize(("worlds", "name"), [(1, "mine.mcap"), (2, "mine_w1.mcap")])
def test_a_recording_of_a_play(place, capfd, monkeypatch, worlds, name):
    from dexsim.cli import play
    from dexsim.cli.main import main

    path = mine(place / name)
    monkeypatch.setattr(play, "replay", never)
    requested = ["policy=zero", "task=grasp", "device=cpu", "episodes=2", "video=false", "out=o"]
    refused(capfd, main(["play", *requested, "record=mine.mcap", f"record_worlds={worlds}"]), path)


@pytest.mark.parametrize("name", ["metrics.json", "simulated.mcap", "position.png", "video.mp4"])
def test_a_replay(place, capfd, monkeypatch, name):
    from dexsim.cli.main import main
    from dexsim.recording import mechanism, write

    monkeypatch.setattr(mechanism, "replay", never)
    write(place / "a.mcap", signal(2.0, xhand.JOINTS))
    path = mine(place / "o" / name)
    refused(capfd, main(["play", "replay=a.mcap", "hand=xhand", "out=o"]), path)


def test_excitation(place, capfd, monkeypatch):
    monkeypatch.setattr("dexsim.recording.excitation.plan", never)
    path = mine(place / "o" / "excite.csv")
    refused(capfd, guard(excite.main, ["out=o"]), path)


@pytest.mark.parametrize("name", ["held.npz", "held"])
def test_held_poses(place, capfd, monkeypatch, name):
    monkeypatch.setattr("dexsim.tasks.make_grasps.generate", never)
    path = mine(place / "held.npz")
    refused(capfd, guard(stable_grasps.main, [f"out={name}"]), path)


@pytest.mark.parametrize("name", ["object.npz", "picture.png", "a.obj"])
def test_an_object(place, capfd, monkeypatch, name):
    monkeypatch.setattr("dexsim.assets.objects.own.own_shape", never)
    path = mine(place / name)
    if name == "a.obj":  # the mesh itself
        with pytest.raises(UserError, match="part_0.obj is read and would be written"):
            import_object.main(["part_0.obj", "out=."])
    else:
        refused(capfd, guard(import_object.main, ["a.obj", "out=."]), path)


def test_pictures_of_a_hands_check(place, capfd, monkeypatch):
    monkeypatch.setattr(moves, "moves", never)
    path = mine(place / "o" / "check.png")
    refused(capfd, guard(moves.main, ["xhand", "out=o"]), path)


def test_held_poses_are_whole_or_not_there(tmp_path, monkeypatch):
    from dexsim.tasks.stable_grasps import GraspSet

    poses = GraspSet(*(torch.zeros(shape) for shape in ((2,), (2, 12), (2, 12), (2, 7))))
    poses.save(tmp_path / "held.npz")
    before = (tmp_path / "held.npz").read_bytes()

    def half(file, **arrays):
        file.write(b"PK")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", half)
    with pytest.raises(OSError, match="No space"):
        poses.save(tmp_path / "held.npz")
    assert (tmp_path / "held.npz").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("sizes=[", "sizes=[: cannot be read as YAML"),
        ("sizes=[a, b]", "edges within"),
        ("sizes=[true, 1]", "edges within"),
        ("hold=[palm]", "must be palm or fingertips"),
        ("hold={a: 1}", "must be palm or fingertips"),
        ("count='", "must be a whole number from 1"),
        ("count=true", "must be a whole number from 1"),
        ("seed=-1", "must be a whole number from 0"),
        ("seed=x", "must be a whole number from 0"),
        ("out=", "must be a file to write"),
        ("out=..", "must be a file to write"),
        ("worlds=\x00", "must be a whole number from 1"),
    ],
)
def test_values_of_held_poses_that_are_none(place, setting, said):
    with pytest.raises(UserError) as error:
        stable_grasps.main([setting])
    assert said in str(error.value) and "\n" not in str(error.value) and not list(place.iterdir())


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["deploy", "record=a\x00b"], "a path holds no zero character"),
        (["deploy", "record=\ud800"], "no path holds its character 0"),
        (["convert", "a.mcap", "out=b.mcap", "meta.robot=x\udcff"], "meta.robot=x\\udcff: character 1 is no text"),
        (["play", "replay="], "say what to play"),
        (["import-object", "a.obj", "out=a\x00b"], "a path holds no zero character"),
        (["import-object", "a.obj", "out=o", "hulls=nan"], "hulls=nan: must be a whole number from 1 to 32"),
        (["export", "checkpoint=a.pt", "out=o", f"seed={10**20}"], f"seed={10**20}: must be a whole number from 0"),
        (["export", "checkpoint=a.pt", "out=o", "steps=\u00b2"], ": must be a whole number from 2 to 100000"),
        (["deploy", "record=none", "seed=-1"], "seed=-1: must be a whole number from 0"),
        (["diagnose", "recordings=[a.mcap]", "seed=--5"], "seed=--5: must be a whole number from 0"),
        (["diagnose", "recordings=[there.mcap]", "model=a\x00"], "a path holds no zero character"),
        (["calibrate", "real=a\x00", "out=o"], "a path holds no zero character"),
        (["diagnose", "recordings=[a.mcap]", "columns=["], "columns=: cannot be read as YAML"),
        (["import-object", "a.obj", "out=o", "hulls=1.5"], "hulls=1.5: must be a whole number from 1 to 32"),
    ],
)
def test_arguments_that_are_no_text(bundle_of_zeros, place, capfd, command, said):
    from dexsim.cli.main import main

    (place / "there.mcap").write_bytes(b"")
    own = [f"bundle={bundle_of_zeros}"] if command[0] == "deploy" else []
    capfd.readouterr()
    assert main([*command, *own]) == 2
    err = capfd.readouterr().err
    assert said in err and err.count("\n") == 1, err
