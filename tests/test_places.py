"""Places that cannot be used: a line, or the work goes on with one of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dexsim.cli import settings
from dexsim.console import folders
from dexsim.paths import CONFIGS

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    "environment",
    [{"HOME": "/proc"}, {"HOME": ""}, {"HOME": None}, {"XDG_CACHE_HOME": "/proc/x"}, {"WARP_CACHE_PATH": "/proc/x"}],
)
def test_libraries_have_a_cache_that_can_be_written(environment, monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("XDG_CACHE_HOME", "WARP_CACHE_PATH", "MPLCONFIGDIR"):
        monkeypatch.setenv(name, str(tmp_path))  # so that it is put back
        monkeypatch.delenv(name)
    for name, value in environment.items():
        monkeypatch.setenv(name, value) if value is not None else monkeypatch.delenv(name)
    folders.caches()
    for name in ("XDG_CACHE_HOME", "WARP_CACHE_PATH"):
        place = os.environ.get(name)
        assert place is None or os.access(place, os.W_OK), (name, place)
    if environment == {"HOME": "/proc"}:
        assert os.environ["XDG_CACHE_HOME"]


def test_a_working_folder_that_is_gone_and_an_output_that_is_full_are_one_line(tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    dexsim = f"{sys.executable} -m dexsim"
    script = f"rmdir {gone}; {dexsim} audit x.csv; cd {tmp_path}; {dexsim} --help >/dev/full"
    said = subprocess.run(
        ["sh", "-c", script], cwd=gone, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    first, second = said.stderr.splitlines()
    assert first.startswith("error: the folder that you are in is gone")
    assert second.startswith("error: the disk is full, or what the output goes to")


@pytest.mark.slow
def test_a_policy_is_exported_and_deployed_where_there_is_no_home_and_no_temporary_folder(tmp_path):
    (tmp_path / "añ b").mkdir()
    policy, bundle = tmp_path / "chéck pünkt.pt", tmp_path / "öut (1)"
    policy.write_bytes((ROOT / "checkpoints" / "rotate_proprioception.pt").read_bytes())
    env = os.environ | {"PYTHONPATH": str(ROOT), "HOME": "/proc", "TMPDIR": "/nowhere/x"}
    patient = ["seconds=0.2", "home_speed=10", "wait=0", "late=1", "stale=1", "hang=2", "overruns=1000"]
    for arguments in (
        ["export", f"checkpoint={policy}", f"out={bundle}", "steps=2"],
        ["deploy", f"bundle={bundle}", f"record={tmp_path}/añ b/ü c.mcap", *patient],
        ["deploy", f"bundle={bundle}", "driver=xhand", "port=fake", "record=none", *patient],
    ):
        done = subprocess.run([sys.executable, "-m", "dexsim", *arguments], env=env, capture_output=True, text=True)
        assert done.returncode == 0 and "Traceback" not in done.stderr, (arguments, done.stdout, done.stderr)
    assert (tmp_path / "añ b" / "ü c.mcap").stat().st_size > 1000


@pytest.mark.parametrize("path", ["/a b/ü c.pt", "it's", "/x/[y] (2)", "C:\\a b\\", "a#b;c"])
def test_a_path_is_taken_as_it_was_typed(path):
    (override,) = settings.parse([f"resume={path}"], CONFIGS).values
    assert str(override.value()).strip("'\"").replace("\\\\", "\\").replace("\\'", "'") == path


def test_paths_in_a_list_are_taken_as_they_were_typed():
    (override,) = settings.parse(["task.objects.train=[/a b/müg 1.stl, box,it's.obj]"], CONFIGS).values
    assert [str(x).strip("'").replace("\\'", "'") for x in override.value()] == ["/a b/müg 1.stl", "box", "it's.obj"]


def test_a_list_that_is_not_closed_is_still_refused():
    with pytest.raises(ValueError, match="cannot read 'task.objects.train=\\[a'"):
        settings.parse(["task.objects.train=[a"], CONFIGS)
