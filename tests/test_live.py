"""The live view: meshes, panels, controls, and the page in a real headless browser."""

from __future__ import annotations

import os
import re
import socket
import sys
import threading
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest
import shell
import torch
from browser import CHROMIUM, Page

from dexsim.cli import start as start_up
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.paths import CONFIGS
from dexsim.tactile.layout import hand_layout
from dexsim.view import live_panels as panels
from dexsim.view.live_meshes import body_meshes

# --- meshes


def volume(vertices, faces):
    """Return the signed volume of a closed surface: positive where its triangles turn outwards."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize(
    "kind, size, expected",
    [
        ("box", "0.1 0.2 0.3", 8 * 0.1 * 0.2 * 0.3),
        ("sphere", "0.1", 4 / 3 * np.pi * 1e-3),
        ("cylinder", "0.1 0.2", np.pi * 0.01 * 0.4),
        ("capsule", "0.1 0.2", np.pi * 0.01 * 0.4 + 4 / 3 * np.pi * 1e-3),
        ("ellipsoid", "0.1 0.2 0.3", 4 / 3 * np.pi * 6e-3),
    ],
)
def test_primitives_are_closed_outward_and_of_the_right_size(kind, size, expected):
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body><geom type="{kind}" size="{size}" pos="1 2 3" quat="1 1 0 '
        '0"/></body></worldbody></mujoco>'
    )
    (mesh,) = body_meshes(model)[1]
    # a round shape of 24 sides is smaller
    assert volume(mesh.vertices - [1, 2, 3], mesh.faces) == pytest.approx(expected, rel=0.03)
    assert np.allclose((mesh.vertices.min(0) + mesh.vertices.max(0)) / 2, [1, 2, 3])


def test_parked_hidden_and_far_geoms_are_left_out():
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><geom type="plane" size="1 1 1"/><body>
 <geom size="0.1"/>
        <geom size="0.1" pos="0 0 1000"/><geom size="0.1" group="3"/><geom size="0.1" rgba="1 0 0 0"/></body>
 </worldbody></mujoco>""")
    found = body_meshes(model)
    assert list(found) == [1] and len(found[1]) == 1 and np.abs(found[1][0].vertices).max() < 0.11


# --- panels

def test_colours_darken_with_force():
    values = panels.colours(np.linspace(0, 1, 20), 1.0).astype(int)
    assert (
        values.shape == (20, 3)
        and (np.diff(values[:, 1]) <= 0).sum() >= 17
        and values[0].sum() > 550 > 150 > values[-1].sum()
    )
    assert (panels.colours(np.array([2.0]), 1.0) == values[-1]).all()


def test_a_pressed_taxel_shows_on_its_own_fingertip_only():
    layout = hand_layout(load_hand())
    displayed = panels.TaxelMap(layout)
    force = np.zeros(layout.area.shape)
    calm = displayed.image(force, 1.0)
    for finger in range(5):
        force[:] = 0
        force[finger, 60] = 1.0
        changed = (displayed.image(force, 1.0) != calm).any(-1)
        columns = np.flatnonzero(changed.any(0))
        remaining = finger * (panels.PAD_WIDTH + panels.GAP)
        assert 4 <= changed.sum() <= 0.1 * panels.PAD_WIDTH * panels.PAD_HEIGHT
        assert remaining <= columns.min() and columns.max() < remaining + panels.PAD_WIDTH
    every = {tuple(p) for f in range(5) for p in np.unique(displayed._nearest[f][displayed._inside[f]])[:, None]}
    assert len(every) == 120  # each taxel has a place


def test_the_end_of_the_finger_is_up():
    layout = hand_layout(load_hand())
    displayed = panels.TaxelMap(layout)
    force = np.zeros(layout.area.shape)
    calm = displayed.image(force, 1.0)
    for finger, axis in enumerate((1, 2, 2, 2, 2)):  # the thumb's distal link points along y, the others' along z
        force[:] = 0
        force[finger, layout.point[finger, :, axis].argmax()] = 1.0
        rows = np.flatnonzero((displayed.image(force, 1.0) != calm).any(-1).any(1))
        assert rows.mean() < 0.35 * panels.PAD_HEIGHT, layout.names[finger]


def test_force_bars_show_force_and_command():
    text = panels.force_bars(["thumb", "index"], np.array([3.0, 6.0]), np.array([np.nan, 9.0]), 12.0)
    assert "width:25.0%" in text and "width:50.0%" in text and "calc(75.0% - 1px)" in text and text.count("calc(") == 1
    assert ">3.0<" in text and "6.0 / 9.0" in text
    assert "command" not in panels.force_bars(["a"], np.array([1.0]), None, 12.0)


def test_reward_bars_go_left_for_losses_and_names_are_escaped():
    text = panels.reward_bars({"good": 0.5, "<bad>": -0.25}, {"good": 2.0, "<bad>": -1.0}, 1.0)
    assert (
        "&lt;bad&gt;" in text
        and "<bad>" not in text
        and re.search(r"width:25.0%;left:50%", text)
        and re.search(r"width:12.5%;right:50%", text)
    )
    assert "this step +0.250, this episode +1.0" in text and "-0.000" not in panels.reward_bars({"x": -1e-6}, {}, 1.0)


# --- the view without a browser

pytest.importorskip("viser", reason="viser is not installed (pip install viser)")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def env():
    torch.set_num_threads(1)
    from dexsim.tasks import make_env

    start = start_up.for_play(
        ["policy=zero", "task=grasp", "device=cpu", "view=true", "worlds=2", "seed=3", "sim.threads=1"], CONFIGS
    )
    assert start.cfg["tactile"]["raw"] is True
    return make_env(start.cfg, 2, "cpu", 3, "auto")


@pytest.fixture
def view(env):
    from dexsim.view.live import LiveView

    rewards = env.rewards
    policies = {"zero": lambda obs: torch.zeros(2, 12), "close": env.scripted_policy()}

    def load(name):
        if name not in policies:
            raise UserError(f"{name}: trained on other observations")
        return policies[name]

    env.reset_all()
    view = LiveView(env, policies["close"], "close", [*policies, "broken.pt"], load, "127.0.0.1", free_port())
    yield view
    view.stop()
    env.rewards, env.fixed_command = rewards, None


def test_serves_on_loopback_only(view):
    with socket.create_connection(("127.0.0.1", view.port), timeout=5):
        pass
    listening = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    hosts = {x[1].split(":")[0] for x in listening if int(x[1].split(":")[1], 16) == view.port and x[3] == "0A"}
    assert hosts == {"0100007F"}


@pytest.mark.slow
def test_pause_step_world_policy_command_and_restart(view, env):
    w = view.wishes
    w.pause, w.steps = True, 7
    view.run(seconds=1.5)
    assert view.steps == 7 and int(env.episode_length_buf[0]) == 7
    assert "paused" in view._facts.content and 'data-fact="step">7<' in view._facts.content
    displayed = view._object[0].vertices.copy()
    w.world, w.steps = 1, 1
    view.run(seconds=0.7)
    assert "1 of 2" in view._facts.content
    # the other world's object
    assert len(view._object[0].vertices) != len(displayed) or not np.allclose(view._object[0].vertices, displayed)
    w.policy, w.command, w.steps = "zero", 0.75, 2
    view.run(seconds=0.7)
    assert view.name == "zero" and view.steps == 2 and float(env.command[1]) == 0.75
    assert f"/ {0.75 * env.f_max:.1f}" in view._forces.content
    w.policy = "broken.pt"
    view.run(seconds=0.3)
    assert view.name == "zero" and "other observations" in view._facts.content


def test_touch_is_shown_where_it_is_felt(view, env):
    view.wishes.speed = "fastest"
    blank = view._image.image.copy()
    give_up = time.monotonic() + 60.0
    measured = np.zeros((5, 120))
    # how far "fastest" comes is the machine's affair; an object between two throws is not felt
    while view.steps <= 60 or measured.sum() == 0:
        assert time.monotonic() < give_up, f"{view.steps} steps, none of the last of a second felt anything"
        view.run(seconds=1.0)
        measured = env.touch.raw[0].numpy()
    view.draw(panels_too=True)
    assert (view._image.image != blank).any()
    finger = int(measured.sum(1).argmax())
    pressed = view._points[finger].colors.astype(int)
    assert pressed[measured[finger].argmax()].sum() < pressed[measured[finger].argmin()].sum()
    assert {k for k in view._terms if env.task["rewards"][k]} == {row[0] for row in env.describe()["rewards"]}


def test_a_port_in_use_is_one_line(view, env):
    from dexsim.view.live import LiveView

    with pytest.raises(UserError, match=f"view_port={view.port}: cannot serve there"):
        LiveView(env, view.policy, "close", ["close"], view._load, "127.0.0.1", view.port)


# --- the page

@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here (Debian, Ubuntu: apt-get install chromium)")
def test_the_page_in_a_browser(view, env, tmp_path):
    """Opened in Chromium: the hand is drawn, figures move, pause and step work, another policy can be chosen."""
    view.wishes.speed = "1/4"  # fewer pictures to draw
    loop = threading.Thread(target=view.run, daemon=True)
    loop.start()
    page = Page(f"http://127.0.0.1:{view.port}", size=(900, 640))

    def step() -> int:
        return int(page.js("document.querySelector('[data-fact=step]').innerText"))

    try:
        page.wait(
            "['[data-fact=step]', '[data-panel=rewards]', 'canvas'].every(x => document.querySelector(x) !== null)"
        )
        # 5 fingers x 3 cells
        assert page.js("document.querySelectorAll('[data-panel=force-bars] > div:last-child > div').length") == 15
        assert page.js("[...document.images].some(i => i.naturalWidth > 300)")  # the taxel maps
        first = step()
        page.wait(f"+document.querySelector('[data-fact=step]').innerText > {first + 5}")
        page.click("step")
        page.wait("document.querySelector('[data-fact=state]').innerText === 'paused'")
        time.sleep(0.5)
        still = step()
        time.sleep(0.5)
        assert step() == still
        page.click("10 steps")
        page.wait(f"document.querySelector('[data-fact=step]').innerText === '{still + 10}'")
        page.click("new episodes")
        page.wait("document.querySelector('[data-fact=step]').innerText === '0'")
        picture = page.screenshot(tmp_path / "page.png")
        from PIL import Image

        scene = np.asarray(Image.open(picture).convert("RGB"))[95:300, 10:250].astype(int)
        drawn = np.abs(scene - scene[:, :1]).sum(-1) > 40  # against the background's left edge
        orange = (scene[..., 0] > scene[..., 2] + 60) & drawn
        assert drawn.mean() > 0.04 and orange.mean() > 0.002, "hand and object are not in the picture"
        assert not page.log
    finally:
        page.close()
        view._stopped.set()
        loop.join(10)


@pytest.mark.slow
@pytest.mark.parametrize(
    "what", [("policy=scripted", "task=grasp"), ("policy=zero", "task=rotate", "task.perception=imu")]
)
def test_play_serves_and_ends_with_ctrl_c(tmp_path, what):
    import signal
    import subprocess
    import urllib.request

    port = free_port()
    with open(tmp_path / "log", "w") as log:
        process = subprocess.Popen(
            [
                sys.executable,
                str(shell.ROOT / "play.py"),
                *what,
                "view=true",
                f"view_port={port}",
                "device=cpu",
                "worlds=2",
                "sim.threads=1",
            ],
            cwd=tmp_path,
            stdout=log,
            stderr=log,
        )
    end = time.monotonic() + 120
    while "ssh -L" not in (tmp_path / "log").read_text():
        assert process.poll() is None and time.monotonic() < end, (tmp_path / "log").read_text()[-2000:]
        time.sleep(0.3)
    assert f"http://localhost:{port}" in (tmp_path / "log").read_text()
    with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=20) as page:
        assert page.status == 200 and b"<html" in page.read()
    time.sleep(3)
    assert process.poll() is None, (tmp_path / "log").read_text()[-2000:]  # it steps and draws
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 0, (tmp_path / "log").read_text()[-2000:]


def test_a_page_follows_a_run(env, tmp_path):
    """A slider position for each checkpoint that is saved, the last for the newest policy, which is played anew."""
    from dexsim.view.live import LiveView, Run

    def save(name, number):
        (tmp_path / name).write_text(str(number))

    save("policy.pt", 0), save("model_10.pt", 10), save("model_9.pt", 9)
    rows = "iteration,steps,reward,reward/goal,task/drift", "1,8,,0.5,0.1", "2,16,3,0.7,0.2"
    (tmp_path / "progress.csv").write_text("\n".join(rows) + "\n")
    run, rewards, taken = Run(tmp_path / "policy.pt", {}), env.rewards, []
    assert run.names() == ["model_9.pt", "model_10.pt", "policy.pt"] and not run.changed()

    def load(name):
        taken.append((name, (tmp_path / name).read_text()))
        return lambda obs: torch.zeros(2, 12)

    view = LiveView(env, load("policy.pt"), "policy.pt", ["policy.pt", "zero"], load, "127.0.0.1", free_port(), run)
    try:
        view.run(seconds=0.3)
        assert view._checkpoint.max == 2 and view._checkpoint.value == 2
        assert view._policy_choice.options == ("policy.pt", "model_10.pt", "model_9.pt", "zero")
        assert all(word in view._training.content for word in ("goal", "drift", ">2<"))
        save("model_20.pt", 20), save("policy.pt", 1)
        os.utime(tmp_path / "policy.pt", (1e9, 1e9))
        view.run(seconds=0.3)
        assert taken[-1] == ("policy.pt", "1") and view._checkpoint.value == 3
        view.wishes.policy = view._names[1]  # as the slider asks
        view.run(seconds=0.3)
        assert view.name == "model_10.pt" and taken[-1] == ("model_10.pt", "10")
    finally:
        view.stop()
        env.rewards = rewards


@pytest.mark.slow
def test_a_training_is_watched_and_takes_its_page_along(tmp_path):
    import signal
    import subprocess

    port, said = free_port(), tmp_path / "run" / "view.log"
    train = [sys.executable, str(shell.ROOT / "train.py"), "task=rotate", "preset=none", "device=cpu", "worlds=2",
             "agent.num_steps_per_env=8", "agent.actor.hidden_dims=[8]", "agent.critic.hidden_dims=[8]", "seed=3",
             "iterations=100000", "view=true", f"view_port={port}", f"out={tmp_path / 'run'}"]  # fmt: skip
    process = subprocess.Popen(train, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def served():
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    end = time.monotonic() + 240
    while not (said.is_file() and "ssh -L" in said.read_text()):
        assert process.poll() is None and time.monotonic() < end, said.read_text() if said.is_file() else ""
        time.sleep(0.5)
    assert served()
    process.send_signal(signal.SIGKILL)  # it has no time to end the other
    process.wait(30)
    while served():
        assert time.monotonic() < end, "the page outlives its training"
        time.sleep(0.5)


# --- strangers


def pack(kind: str, **fields) -> bytes:
    import msgspec

    return msgspec.msgpack.encode({"type": kind, **fields})


def camera() -> bytes:
    return pack(
        "ViewerCameraMessage",
        wxyz=[1, 0, 0, 0],
        position=[0, 0, 1],
        fov=1.0,
        image_height=10,
        image_width=10,
        near=0.01,
        far=10.0,
        look_at=[0, 0, 0],
        up_direction=[0, 0, 1],
    )


def open_socket(port: int, origin: str | None = "same", host: str | None = None, path: str = "", headers=()):
    import viser
    from websockets.sync.client import connect

    extra = dict(headers) | ({"Host": host} if host else {})
    return connect(
        f"ws://127.0.0.1:{port}{path}",
        origin=f"http://127.0.0.1:{port}" if origin == "same" else origin,
        subprotocols=[f"viser-v{viser.__version__}"],
        additional_headers=extra,
        open_timeout=20,
        max_size=2**26,
    )


def status(port: int, **how) -> int:
    from websockets.exceptions import InvalidStatus

    try:
        open_socket(port, **how).close()
    except InvalidStatus as error:
        return error.response.status_code
    return 101


def fetch(
    port: int, path: str = "/", host: str | None = None, address: str = "127.0.0.1", **headers
) -> tuple[int, dict]:
    import http.client

    connection = http.client.HTTPConnection(address, port, timeout=20)
    connection.request(
        "GET",
        path,
        headers={"Host": host or f"{address}:{port}"} | {k.replace("_", "-"): v for k, v in headers.items()},
    )
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer.status, dict(answer.getheaders())


def test_what_the_gate_makes_of_odd_headers():
    """An Upgrade within a list still needs its Origin; a token of bytes that are no text is another token."""
    from websockets.datastructures import Headers

    from dexsim.view.live_gate import Gate

    here = Gate("127.0.0.1")
    for upgrade in ("websocket", "WebSocket", "websocket,", "h2c, websocket", " ,websocket ; x"):
        foreign = Headers({"Host": "127.0.0.1:8080", "Upgrade": upgrade, "Origin": "http://evil.example"})
        assert here.reason("/", foreign)[0] == 403, upgrade
    far = Gate("0.0.0.0")
    for path, cookie in (("/", "dexsim=\xe4"), ("/?token=%E4", ""), ("/?token=%ED%A0%80", "dexsim="), ("/?token=", "")):
        assert far.reason(path, Headers({"Host": "x:8080", "Cookie": cookie}))[0] == 401, (path, cookie)
    assert far.reason(f"/?token={far.token}", Headers({"Host": "x:8080"})) is None


def test_only_the_page_that_is_served_may_connect(view):
    port = view.port
    assert status(port) == 101 and fetch(port)[0] == 200
    for origin in (
        "http://evil.example",
        "null",
        None,
        f"http://localhost:{port}",
        f"http://127.0.0.1:{port + 1}",
        "http://127.0.0.1",
        f"http://127.0.0.1:{port}.evil.example",
        f"http://evil@127.0.0.1:{port}",
        f"file://127.0.0.1:{port}",
        "http://[",
    ):
        assert status(port, origin=origin) == 403, origin
    for host in (
        "evil.example",
        f"evil.example:{port}",
        f"127.0.0.1.evil.example:{port}",
        "169.254.169.254",
        f"localhost.evil:{port}",
    ):
        assert fetch(port, host=host)[0] == 403, host
    assert fetch(port, host=f"localhost:{port}")[0] == 200 and fetch(port, host=f"LOCALHOST:{port + 5}")[0] == 200, (
        "through ssh -L too"
    )
    assert fetch(port, "/../../etc/passwd")[0] == 404 and fetch(port, "/%2e%2e/%2e%2e/etc/passwd")[0] == 404


def hostile(ids: dict[str, str]):
    """Yield 1,000 messages that no page of ours sends."""
    values = [
        -1000,
        10**9,
        "abc",
        "0/1",
        "1/0",
        "",
        None,
        [],
        {},
        [1] * 1000,
        float("nan"),
        float("inf"),
        True,
        2.5,
        "x" * 10_000,
        b"\0" * 100,
        {"a": {"b": []}},
        "../../etc/passwd",
        "<script>alert(1)</script>",
        -1,
    ]
    for value in values:
        for uuid in ids.values():
            yield pack("GuiUpdateMessage", uuid=uuid, updates={"value": value})
    for uuid in ids.values():
        for prop in (
            "update_cb",
            "sync_cb",
            "removed",
            "uuid",
            "props",
            "is_button",
            "__class__",
            "update_timestamp",
            "nothing",
        ):
            yield pack("GuiUpdateMessage", uuid=uuid, updates={prop: 5})
            yield pack("GuiUpdateMessage", uuid=uuid, updates={"value": "1", prop: [5]})
        yield pack("GuiUpdateMessage", uuid=uuid, updates=[])
        yield pack("GuiButtonHoldMessage", uuid=uuid, frequency=10.0)
        yield pack(
            "FileTransferStartUpload",
            source_component_uuid=uuid,
            transfer_uuid="x",
            filename="../x",
            mime_type="a",
            part_count=10**9,
            size_bytes=10**12,
        )
    others = [
        "ViewerCameraMessage",
        "ResetSceneMessage",
        "RemoveSceneNodeMessage",
        "SceneNodeClickMessage",
        "TransformControlsUpdateMessage",
        "Nothing",
        "RunJavascriptMessage",
        "SetPositionMessage",
        "ShareUrlRequest",
        "GuiCloseModalMessage",
        "FileTransferPart",
        "CommandTriggerMessage",
    ]
    for kind in others:
        yield pack(kind)
        yield pack(kind, name="/bodies", uuid="x", wxyz=[1], position="abc", updates={})
    raw = [b"", b"\xc1", b"\x81", b"\xdd\xff\xff\xff\xff", bytes(1000), b"\xff" * 500, pack("GuiUpdateMessage")[:-3]]
    yield from raw
    while True:
        for uuid in ids.values():
            yield pack("GuiUpdateMessage", uuid=uuid, updates={"value": -1000})


@pytest.mark.slow
def test_a_thousand_hostile_messages_end_nothing(view, env):
    from websockets.exceptions import ConnectionClosed

    ids = {name: h._impl.uuid for h in view.server.gui._gui_input_handle_from_uuid.values() for name in [h._impl.uuid]}
    assert len(ids) == 8
    loop = threading.Thread(target=view.run, daemon=True)
    loop.start()
    view.wishes.speed = "1/4"
    messages, sent = hostile(ids), 0
    socket_ = open_socket(view.port)
    socket_.send(camera())
    while sent < 1000:
        try:
            socket_.send(next(messages))
            sent += 1
            if sent % 50 == 0:
                socket_.ping().wait(0.5)  # not for ever: a connection that was ended answers none
        except ConnectionClosed:  # what cannot be read ends its own connection
            socket_ = open_socket(view.port)
            socket_.send(camera())
    socket_.close()
    time.sleep(0.3)
    assert (
        loop.is_alive() and view.wishes.world in (0, 1) and view.wishes.speed in ("1/10", "1/4", "1/2", "1", "fastest")
    )
    with open_socket(view.port) as ours:  # and the controls still work
        ours.send(camera())
        world = next(
            u for u, h in view.server.gui._gui_input_handle_from_uuid.items() if getattr(h, "label", "") == "world"
        )
        before, limit = view.wishes.world, time.monotonic() + 60
        ours.send(pack("GuiUpdateMessage", uuid=world, updates={"value": 1 - before}))
        while view.wishes.world == before and time.monotonic() < limit:
            time.sleep(0.02)
        assert view.wishes.world == 1 - before
    steps, limit = view.steps, time.monotonic() + 60
    while view.steps == steps and not view.wishes.pause and time.monotonic() < limit:
        time.sleep(0.02)
    assert loop.is_alive() and (view.steps > steps or view.wishes.pause)
    view._stopped.set()
    loop.join(10)
    assert not loop.is_alive()


def test_more_sockets_than_there_is_room_for_end_nothing(view, monkeypatch):
    from websockets.exceptions import ConnectionClosed

    from dexsim.view import live_gate

    monkeypatch.setattr(live_gate, "MOST_CLIENTS", 6)  # each is sent the whole scene

    loop = threading.Thread(target=view.run, daemon=True)
    loop.start()
    view.wishes.speed = "1/4"
    raw = [socket.create_connection(("127.0.0.1", view.port), timeout=20) for _ in range(80)]
    for k, s in enumerate(raw):
        s.sendall(
            (
                b"GET / HTTP/1.1\r\n",
                b"\x16\x03\x01" + bytes(50),
                b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\n",
                b"",
            )[k % 4]
        )
    full = []
    for _ in range(20):
        full.append(open_socket(view.port))
    told_to_wait = 0
    for s in full:
        try:
            s.recv(timeout=5)
        except ConnectionClosed as closed:
            told_to_wait += closed.rcvd is not None and closed.rcvd.code == 1013
    assert told_to_wait >= 20 - 6 and view.gate.clients <= 6
    assert loop.is_alive()
    for s in (*raw, *full):
        s.close()
    limit = time.monotonic() + 60
    while status(view.port) != 101 or view.gate.clients > 5:
        assert time.monotonic() < limit
        time.sleep(0.1)
    steps, limit = view.steps, time.monotonic() + 60
    while view.steps == steps and time.monotonic() < limit:
        time.sleep(0.02)
    assert loop.is_alive() and view.steps > steps
    view._stopped.set()
    loop.join(10)


def test_a_picture_that_fails_costs_a_picture_and_a_fault_that_stays_is_told(view, monkeypatch):
    draw, calls = view._draw, []

    def failing(panels_too):
        calls.append(1)
        if len(calls) % 2:
            raise RuntimeError("dictionary changed size during iteration")
        draw(panels_too)

    monkeypatch.setattr(view, "_draw", failing)
    limit = time.monotonic() + 60
    while len(calls) <= 3 and time.monotonic() < limit:
        view.run(seconds=0.5)
    assert len(calls) > 3
    monkeypatch.setattr("dexsim.view.live.MOST_FAILED_DRAWS", 3)
    monkeypatch.setattr(view, "_draw", lambda panels_too: (_ for _ in ()).throw(RuntimeError("a bug")))
    with pytest.raises(RuntimeError, match="a bug"):
        view.run(seconds=5)


def test_beyond_loopback_a_token_is_asked_for(view, env):
    from dexsim.view.live import LiveView

    assert view.token == ""
    wide = LiveView(env, view.policy, "close", ["close"], view._load, "0.0.0.0", free_port())
    try:
        port, token = wide.port, wide.token
        assert len(token) >= 20
        assert (
            fetch(port)[0] == 401
            and fetch(port, "/?token=wrong")[0] == 401
            and fetch(port, "/index.html", Cookie="dexsim=x")[0] == 401
        )
        assert status(port) == 401 and status(port, path="/?token=no") == 401
        code, headers = fetch(port, f"/?token={token}", host="any.name:1")
        assert code == 200 and "HttpOnly" in headers["Set-Cookie"] and "SameSite=Strict" in headers["Set-Cookie"]
        cookie = headers["Set-Cookie"].split(";")[0]
        assert fetch(port, Cookie=cookie)[0] == 200 and status(port, headers={"Cookie": cookie}) == 101
        assert status(port, headers={"Cookie": cookie}, origin="http://evil.example") == 403, (
            "a foreign page with the cookie"
        )
    finally:
        wide.stop()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here (Debian, Ubuntu: apt-get install chromium)")
def test_the_page_with_its_token_in_a_browser(view, env):
    """The token of the address is a cookie from then on, which the page's WebSocket carries."""
    from dexsim.view.live import LiveView

    wide = LiveView(env, view.policy, "close", ["close"], view._load, "0.0.0.0", free_port())
    loop = threading.Thread(target=wide.run, daemon=True)
    loop.start()
    page = Page(f"http://127.0.0.1:{wide.port}/?token={wide.token}")
    try:
        page.wait("document.querySelector('[data-fact=step]') !== null")
        assert wide.gate.clients == 1
    finally:
        page.close()
        wide._stopped.set()
        loop.join(10)
        wide.stop()


@pytest.fixture
def hasty(monkeypatch):
    """Half as long for a handshake, in a view that is made after it."""
    from dexsim.view import live_gate

    monkeypatch.setattr(live_gate, "HANDSHAKE_S", live_gate.HANDSHAKE_S / 2)


@pytest.mark.slow
def test_sockets_that_say_nothing_make_room_for_a_page(hasty, view):
    """Two hundred that never finish their handshake: the oldest go, a page is served meanwhile, and all are gone in
    time."""
    from dexsim.view import live_gate

    silent = [socket.create_connection(("127.0.0.1", view.port), timeout=10) for _ in range(100)]
    for k in range(100):
        silent.append(socket.create_connection(("127.0.0.1", view.port), timeout=10))
        silent[-1].sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Slow: " + b"a" * k)  # a head that does not end
    page = open_socket(view.port)
    assert page.recv(timeout=20)
    assert len(view.gate.waiting) <= live_gate.MOST_WAITING and view.gate.refused >= 200 - live_gate.MOST_WAITING
    end = time.monotonic() + live_gate.HANDSHAKE_S + 10
    while view.gate.waiting and time.monotonic() < end:
        time.sleep(0.1)
    assert not view.gate.waiting
    for s in (*silent, page):
        s.close()
