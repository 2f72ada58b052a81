"""Ready to be published: what a stranger meets first."""

from __future__ import annotations

import http.server
import os
import re
import subprocess
import sys
import sysconfig
import threading
import tomllib
import urllib.request
from pathlib import Path

import pytest
import yaml

from dexsim import system
from dexsim.cli import doctor
from dexsim.cli.main import dispatch
from dexsim.errors import UserError
from dexsim.learning import checkpoint, policies
from dexsim.version import VERSION

ROOT = Path(__file__).resolve().parents[1]


# --- doctor

def test_the_doctor_says_what_is_here_and_ends_with_0(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert dispatch(["doctor"]) == 0
    said = capsys.readouterr().out
    assert f"dexsim {VERSION}" in said and "MuJoCo" in said and said.endswith("dexsim runs here\n")
    assert not list(tmp_path.iterdir())


def test_the_doctor_names_each_lack_with_what_to_do(capsys, monkeypatch, tmp_path):
    """Taken away: every package but one that is too old, OpenGL, memory, the folder, an extra."""
    monkeypatch.setattr(doctor.metadata, "version", lambda name: "0.1" if name == "numpy" else "99")
    monkeypatch.setattr(system, "renderers", lambda: ("none",))
    monkeypatch.setattr(system, "memory", lambda: (1 << 30, 8 << 30))
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: (_ for _ in ()).throw(OSError(30, "read-only")))
    assert dispatch(["doctor"]) == 1
    said = capsys.readouterr().out
    for words in ("numpy<3,>=2.2 is wanted, 0.1 is here", "libegl1", "1.0 of 8.0 GiB free", "read-only", "dexsim[hub]",
                  "dexsim cannot run here"):  # fmt: skip
        assert words in said, words


def test_a_check_that_fails_is_a_line_and_not_the_end(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "gpu", lambda: (_ for _ in ()).throw(RuntimeError("the driver\nis broken")))
    monkeypatch.setattr(doctor, "packages", lambda: iter(()))
    assert dispatch(["doctor"]) == 1
    said = capsys.readouterr().out
    assert "RuntimeError: the driver is broken" in said and "\nok      folder" in said


def test_several_gpus_need_room_to_talk(monkeypatch):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    about = type("About", (), {"name": "A", "total_memory": 80 << 30})
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda k: about)
    monkeypatch.setattr(system, "shared_memory", lambda: 64 << 20)
    lines = list(doctor.gpu())
    assert [x[0] for x in lines] == ["ok", "ok", "lacks"] and "--shm-size" in lines[2][2]
    monkeypatch.setattr(system, "shared_memory", lambda: None)
    assert [x[0] for x in doctor.gpu()] == ["ok", "ok"]


def test_the_versions_of_python_are_those_that_are_resolved_each_night():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    stated = [c.rpartition(" ")[2] for c in project["classifiers"] if ":: Python ::" in c]
    resolved = re.search(r"for version in (.*); do", (ROOT / ".ci" / "nightly").read_text())[1].split()
    assert stated == resolved and project["requires-python"] == f">={stated[0]}"


def test_the_doctor_knows_every_extra():
    extras = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])
    assert set(doctor.EXTRAS) == extras - {"test", "docs", "view"}


# --- policies by name

def test_included_policies_are_played_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert {"grasp", "rotate"} <= set(policies.included())
    assert checkpoint.load("grasp")["config"]["task"]["name"] == "grasp"
    Path("grasp").write_bytes(b"x")  # a file that is there goes first
    assert policies.place("grasp") == Path("grasp")
    with pytest.raises(UserError, match="dexsim comes with grasp, "):
        checkpoint.load("grsp")


class Hub(http.server.BaseHTTPRequestHandler):
    """As much of Hugging Face's server as a download asks for: one repository with one policy."""

    CONTENT, COMMIT = b"", "1" * 40
    requested: list[str] = []

    def do_HEAD(self):
        self._answer(False)

    def do_GET(self):
        self._answer(True)

    def _answer(self, body: bool) -> None:
        Hub.requests.append(f"{self.command} {self.path}")
        found = re.fullmatch(r"/anna/hands/resolve/(main|v1|1{40})/(policy\.pt|more/rotate\.pt)", self.path)
        self.send_response(200 if found else 404)
        if found:
            self.send_header("ETag", '"abc"')
            self.send_header("X-Repo-Commit", self.COMMIT)
            self.send_header("Content-Length", str(len(self.CONTENT)))
        else:
            self.send_header("X-Error-Code", "EntryNotFound" if "/anna/hands/" in self.path else "RepoNotFound")
            self.send_header("Content-Length", "0")
        self.end_headers()
        if body and found:
            self.wfile.write(self.CONTENT)

    def log_message(self, *_):
        pass


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """A local server in the place of Hugging Face, and an empty cache; yields the server's class."""
    pytest.importorskip("huggingface_hub")
    from huggingface_hub import constants

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}"
    monkeypatch.setattr(constants, "ENDPOINT", address)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", address + "/{repo_id}/resolve/{revision}/{filename}")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    Hub.CONTENT, Hub.requests = (ROOT / "checkpoints/grasp.pt").read_bytes(), []
    yield server
    server.shutdown()
    server.server_close()


def test_a_policy_of_the_hub_is_fetched_once(hub):
    data = checkpoint.load("hub:anna/hands")
    assert data["kind"] == "policy" and sum(x.startswith("GET /anna") for x in Hub.requests) == 1, Hub.requests
    assert checkpoint.load("hub:anna/hands@v1")["steps"] == data["steps"]
    assert sum(x.startswith("GET /anna") for x in Hub.requests) == 1  # the same commit
    checkpoint.load("hub:anna/hands/more/rotate.pt")
    hub.shutdown()
    hub.server_close()  # without a network: from the cache
    assert checkpoint.load("hub:anna/hands")["steps"] == data["steps"]


@pytest.mark.parametrize("name, words", [
    ("hub:anna", "OWNER/REPOSITORY"), ("hub:anna//x.pt", "OWNER/REPOSITORY"),
    ("hub:anna/hands/none.pt", "none.pt of revision main cannot be fetched"),
    ("hub:bert/hands", "policy.pt of revision main cannot be fetched"), ("hub:a b/c", "its form is hub:OWNER"),
])  # fmt: skip
def test_what_the_hub_refuses_is_one_line(hub, name, words):
    with pytest.raises(UserError, match=re.escape(words)) as error:
        checkpoint.load(name)
    assert "\n" not in str(error.value) and name in str(error.value)


@pytest.mark.slow
def test_a_hub_that_is_out_of_reach_and_a_file_that_is_no_policy(hub):
    Hub.CONTENT = b"\x80\x04no"
    with pytest.raises(UserError, match="refused, it is a raw pickle"):
        checkpoint.load("hub:anna/hands")
    hub.shutdown()
    hub.server_close()
    with pytest.raises(UserError, match="cannot be reached"):
        checkpoint.load("hub:anna/hands/more/rotate.pt")


def test_without_the_extra_one_line_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(UserError, match=re.escape("pip install 'dexsim[hub]'")):
        policies.place("hub:anna/hands")


# --- the demo

@pytest.mark.parametrize("argument, words", [
    ("policy=x", "must be grasp"), ("browser=1", "true or false"), ("port=x", "whole number"), ("x", "key=value"),
])  # fmt: skip
def test_a_slip_of_the_demo_is_one_line(argument, words):
    with pytest.raises(UserError, match=words):
        dispatch(["demo", argument])


@pytest.mark.slow
def test_the_demo_finds_and_serves(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "dexsim", "demo", "browser=false", "seconds=20"], cwd=tmp_path, text=True,
        stdout=subprocess.PIPE, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    said = ""
    for line in process.stdout:
        said += line
        if found := re.search(r"http://localhost:\d+", line):
            page = urllib.request.urlopen(found[0], timeout=10).read()
            break
    assert b"<html" in page.lower() and (tmp_path / "out/demo/report.html").is_file()
    assert "What was hidden: delay 0.02" in said and process.wait(120) == 0, said


# --- what is written down

def test_versions_agree():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert cited["version"] == VERSION.partition(".dev")[0] and cited["cff-version"] == "1.2.0"
    assert {"title", "authors", "message", "license", "type"} <= set(cited)
    versions = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert versions[0] in ("Unreleased", VERSION) and "0.1.0" in versions


def test_the_release_workflow_runs_what_is_tested_here():
    """Its steps are those of `test_what_is_uploaded`, and only a tag of this version starts them."""
    work = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text())
    assert work[True] == {"push": {"tags": ["v*"]}}  # YAML reads the key `on` as true
    steps = " ; ".join(step.get("run", step.get("uses", "")) for job in work["jobs"].values() for step in job["steps"])
    for words in ("python -m build", "twine check --strict", "pypa/gh-action-pypi-publish", "dexsim doctor", "*.pt"):
        assert words in steps, words
    assert work["jobs"]["publish"]["permissions"] == {"id-token": "write"}


def test_the_recipe_of_a_rented_machine(tmp_path):
    """What it asks of torchrun, with what SkyPilot sets on two machines of four GPUs."""
    recipe = yaml.safe_load((ROOT / "recipes/skypilot.yaml").read_text())
    torchrun = tmp_path / "dexsim-env" / "bin" / "torchrun"
    torchrun.parent.mkdir(parents=True)
    torchrun.write_text('#!/bin/sh\necho "$@"\n')
    torchrun.chmod(0o755)
    sets = {"NODE_IPS": "10.0.0.1\n10.0.0.2", "NUM_NODES": "2", "NUM_GPUS_PER_NODE": "4", "TASK_ID": "a"}
    env = {f"SKYPILOT_{k}": v for k, v in sets.items()} | {"HOME": str(tmp_path), "SETTINGS": "task=grasp seed=2"}
    said = subprocess.run(["bash", "-euc", recipe["run"]], env=os.environ | env, capture_output=True, text=True).stdout
    assert said == (
        "--nnodes=2 --nproc_per_node=4 --rdzv_backend=c10d --rdzv_endpoint=10.0.0.1:29500 --rdzv_id=a"
        f" -m dexsim train task=grasp seed=2 out={tmp_path}/run\n"
    )


@pytest.mark.slow
def test_what_is_uploaded(tmp_path):
    """`python -m build` of what git tracks, `twine check`, and less than 8 MB."""
    source = tmp_path / "source"
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True).stdout.split("\0")
    if not any(names):
        pytest.skip("no git checkout")
    for name in names:
        if name and not name.startswith(("docs/media", "tests/")) and (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    uvx = [Path(sysconfig.get_path("scripts")) / "uvx", "--python", sys.executable, "--from"]
    built = [*uvx, "build", "python", "-m", "build", "-o", tmp_path / "dist", source]
    done = subprocess.run(built, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    wheel, archive = sorted((tmp_path / "dist").iterdir())
    assert wheel.name == f"dexsim-{VERSION}-py3-none-any.whl" and wheel.stat().st_size < 8e6
    assert archive.name == f"dexsim-{VERSION}.tar.gz" and archive.stat().st_size < 16e6
    checked = [*uvx, "twine", "twine", "check", "--strict", wheel, archive]
    done = subprocess.run(checked, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.count("PASSED") == 2, done.stdout
    listing = subprocess.run([sys.executable, "-m", "zipfile", "-l", wheel], capture_output=True, text=True).stdout
    assert "dexsim/policies/grasp.pt" in listing and "dexsim/gap/report/templates" in listing
