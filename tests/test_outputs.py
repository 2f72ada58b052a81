"""Results: nothing that is not ours is overwritten, nothing outside the folder is written, and what is there is
whole."""

from __future__ import annotations

import tempfile
from pathlib import Path

import mujoco
import pytest

from dexsim import outputs
from dexsim.console import folders
from dexsim.errors import UserError
from dexsim.gap.inquiry import Diagnosis, empty
from dexsim.gap.judge.handed_on import save_model
from dexsim.gap.report.files import save

CUBE = "v -.1 -.1 -.1\nv .1 -.1 -.1\nv 0 .1 -.1\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


def result():
    return Diagnosis(empty("unusable"), "so", [])


def test_a_second_diagnosis_replaces_the_first_and_nothing_else(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    written = save(result(), tmp_path)
    assert all(p.is_file() for p in written)
    outputs.claim(tmp_path, "out=", [p.name for p in written])
    save(result(), tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine" and not list(tmp_path.glob(".*.tmp"))


@pytest.mark.parametrize("name", ["report.html", "diagnosis.json"])
def test_a_file_of_the_users_is_not_overwritten(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(UserError, match=f"{name} is not a result written here before"):
        outputs.claim(tmp_path, "out=", [name])
    with pytest.raises(UserError, match=name):
        save(result(), tmp_path)
    assert (tmp_path / name).read_text() == "mine" and sorted(p.name for p in tmp_path.iterdir()) == [name]


def test_a_result_that_was_edited_is_the_users(tmp_path):
    save(result(), tmp_path)
    (tmp_path / "report.html").write_text("edited")
    with pytest.raises(UserError, match="was changed since"):
        save(result(), tmp_path)
    assert (tmp_path / "report.html").read_text() == "edited"


def test_what_is_read_is_not_written(tmp_path):
    save(result(), tmp_path)
    with pytest.raises(UserError, match="is read and would be written"):
        outputs.claim(tmp_path, "out=", ["report.html"], [tmp_path / "report.html"])


def test_links_lead_nowhere(tmp_path):
    out, other = tmp_path / "out", tmp_path / "other"
    out.mkdir()
    other.mkdir()
    (other / "a").write_text("mine")
    (out / "a").symlink_to(other / "a")
    (out / "sub").symlink_to(other)
    for name in ("a", "sub/a"):
        with pytest.raises(UserError, match="overwritten"), outputs.staged(out) as stage:
            (stage / name).parent.mkdir(exist_ok=True)
            (stage / name).write_text("new")
    assert (other / "a").read_text() == "mine"


def test_what_this_diagnosis_does_not_write_no_earlier_one_leaves(tmp_path):
    with outputs.staged(tmp_path) as stage:
        for name in ("tactile.yaml", "model.xml", "other"):
            (stage / name).write_text("of an earlier one")
    (tmp_path / "model.xml").write_text("changed by hand")
    save(result(), tmp_path)
    assert not (tmp_path / "tactile.yaml").exists() and "tactile.yaml" not in (tmp_path / outputs.WRITTEN).read_text()
    assert (tmp_path / "model.xml").read_text() == "changed by hand" and (tmp_path / "other").exists()


def test_what_fails_half_way_leaves_what_was(tmp_path):
    save(result(), tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    with pytest.raises(UserError, match="No space left"), outputs.staged(tmp_path) as stage:
        (stage / "diagnosis.json").write_text("new")
        raise OSError(28, "No space left on device")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_an_unwritable_folder_is_told_before_the_work(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="out="):
        outputs.claim(tmp_path / "file" / "out", "out=", [])


@pytest.mark.parametrize("where", ["meshes", "../../up", ".."])
def test_a_models_meshes_stay_in_its_folder(tmp_path, where):
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    (folder / where).mkdir(exist_ok=True, parents=True)
    mesh = folder / where / "cube.obj"
    mesh.write_text(CUBE)
    (folder / "m.xml").write_text(
        f'<mujoco><asset><mesh name="c" file="{where}/cube.obj"/></asset><worldbody><body><joint/>'
        '<geom type="mesh" mesh="c"/></body></worldbody></mujoco>'
    )
    spec = mujoco.MjSpec.from_file(str(folder / "m.xml"))
    spec.compile()
    out = tmp_path / "x" / "y" / "out"
    out.mkdir(parents=True)
    there = {p for p in tmp_path.rglob("*")}
    save_model(spec, out / "model.xml")
    assert all(p.is_relative_to(out) for p in set(tmp_path.rglob("*")) - there) and mesh.read_text() == CUBE
    mujoco.MjModel.from_xml_path(str(out / "model.xml"))


def killed(work) -> None:
    """Run in a child that ends with kill -9 inside `work`."""
    import os

    child = os.fork()
    if child == 0:
        try:
            work()
        finally:
            os._exit(1)
    assert os.waitpid(child, 0)[1] == 9


@pytest.mark.parametrize("at", [1, 2, 3, 4, 5])
def test_a_kill_among_the_renames_is_made_good_at_the_next_start(tmp_path, at):
    """Notes and results are renamed one by one: after a kill before the k-th of them the next start has all of the old
    or all of the new, and nothing unfinished."""
    import os
    import signal

    names = ("a.json", "b.json", "sub/c.json")

    def write(text):
        with outputs.staged(tmp_path) as stage:
            (stage / "sub").mkdir()
            for name in names:
                (stage / name).write_text(text)

    write("old")
    replace, count = os.replace, []

    def work():
        def kill(a, b):
            count.append(1)
            if len(count) == at:
                os.kill(os.getpid(), signal.SIGKILL)
            replace(a, b)

        os.replace = kill
        write("new")

    killed(work)
    assert list(tmp_path.glob(".results*.tmp")) or at == 5
    outputs.claim(tmp_path, "out=", names)
    assert {(tmp_path / name).read_text() for name in names} == {"old" if at == 1 else "new"}
    assert not list(tmp_path.rglob("*.tmp"))
    write("again")


def test_a_note_of_strangers_moves_nothing(tmp_path):
    import hashlib
    import json

    from dexsim import files

    out, other = tmp_path / "out", tmp_path / "other"
    stage = out / f".results.{files.HOST}.999999999.tmp"
    stage.mkdir(parents=True)
    other.mkdir()
    (other / "x").write_text("mine")
    (out / "mine").write_text("mine")
    (stage / "mine").write_text("new")
    digest = hashlib.sha256(b"new").hexdigest()
    for pending in (
        {"stage": "../other", "files": {"x": "0"}},
        {"stage": stage.name, "files": {"../../other/x": digest, "mine": digest}},
        {"stage": 3, "files": {"a": 1}},
        {"stage": stage.name, "files": []},
        {"files": {"x": "y"}},
        [1],
    ):
        (out / outputs.WRITTEN).write_text(json.dumps({"files": {}, "pending": pending}))
        outputs.recover(out)
        assert (other / "x").read_text() == "mine" and (out / "mine").read_text() == "mine" and other.is_dir()


def test_the_folder_is_tried_with_a_file_that_a_killed_process_cannot_leave(tmp_path, monkeypatch):
    open_unnamed, seen = tempfile.TemporaryFile, []

    def seen_meanwhile(*args, **kwargs):
        file = open_unnamed(*args, **kwargs)
        seen.append((Path(kwargs["dir"]), list(tmp_path.iterdir())))
        return file

    monkeypatch.setattr(folders.tempfile, "TemporaryFile", seen_meanwhile)
    folders.make(tmp_path, "out=")
    assert seen == [(tmp_path, [])]
