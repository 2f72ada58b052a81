"""Plots and video: files are whole and show what they should; without OpenGL there is a clear line."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from dexsim.errors import UserError
from dexsim.view import decor, overlay, plots, render, video

XML = """<mujoco><worldbody><light pos="0 0 1"/><body pos="0 0 0"><freejoint/>
<geom size="0.03" rgba="1 0 0 1"/></body></worldbody></mujoco>"""


def clip(frames=7, **kwargs):
    qpos = np.zeros((frames, 7))
    qpos[:, 3] = 1
    qpos[:, 0] = np.linspace(0.0, 0.1, frames)
    return video.Clip(mujoco.MjModel.from_xml_string(XML), qpos, **kwargs)


def read(path):
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    return meta, [np.frombuffer(f, np.uint8).reshape(height, width, 3) for f in reader]


@pytest.mark.slow
def test_video_has_every_frame_and_shows_the_ball_move(tmp_path):
    seen = []
    try:
        video.render(
            [clip(), clip(5)], tmp_path / "a.mp4", dt=0.05, size=(160, 128), progress=lambda *a: seen.append(a)
        )
    except video.NoRenderer as error:
        pytest.skip(str(error))
    meta, frames = read(tmp_path / "a.mp4")
    assert meta["codec"] == "h264" and meta["pix_fmt"].startswith("yuv420p") and meta["fps"] == 20
    assert len(frames) == 7 and frames[0].shape == (128, 320, 3)
    assert seen[-1] == (7, 7) and os.listdir(tmp_path) == ["a.mp4"]

    def ball(frame):
        red = (frame[:, :160, 0] > 120) & (frame[:, :160, 1] < 90)
        assert red.sum() > 20
        return np.argwhere(red).mean(0)

    moved = np.abs(ball(frames[0]) - ball(frames[-1]))
    assert moved.max() > 5
    held = np.abs(frames[4][:, 160:].astype(int) - frames[6][:, 160:]).mean()
    assert held < 3  # the shorter clip keeps its last frame


@pytest.mark.slow
def test_many_control_steps_a_second_are_thinned(tmp_path):
    try:
        video.render([clip(20)], tmp_path / "a.mp4", dt=0.005, size=(64, 64))
    except video.NoRenderer as error:
        pytest.skip(str(error))
    meta, frames = read(tmp_path / "a.mp4")
    assert meta["fps"] == pytest.approx(1 / 0.035, rel=0.01) and len(frames) == 3  # real time: every seventh step


def test_without_opengl_there_is_one_line(tmp_path, monkeypatch):
    broken = tmp_path / "site"
    broken.mkdir()
    (broken / "sitecustomize.py").write_text(
        "import mujoco\n"
        "class GLContext:\n"
        "    def __init__(self, *a): raise RuntimeError('no display here\\nmore')\n"
        "mujoco.GLContext = GLContext\n")
    monkeypatch.setenv("PYTHONPATH", f"{broken}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with pytest.raises(video.NoRenderer) as caught:
        video.render([clip(2)], tmp_path / "a.mp4", dt=0.05)
    message = str(caught.value)
    assert "egl: no display here; osmesa: " in message and "apt-get install" in message
    assert "\n" not in message and not (tmp_path / "a.mp4").exists()


@pytest.mark.parametrize("name", ["osmesa", "egl", "bogus"])
def test_what_draws_nothing_needs_no_opengl(name):
    hidden = "import ctypes.util as u; u.find_library = lambda name: None; import dexsim, os, mujoco; "
    said = "print(os.environ['MUJOCO_GL'], mujoco.MjModel.from_xml_string('<mujoco/>').nq)"
    done = subprocess.run([sys.executable, "-c", hidden + said], env=os.environ | {"MUJOCO_GL": name},
                          capture_output=True, text=True)  # fmt: skip
    assert done.stdout.split() == ["off", "0"], done.stderr


def test_a_crashing_driver_does_not_take_us_down(tmp_path, monkeypatch):
    broken = tmp_path / "site"
    broken.mkdir()
    (broken / "sitecustomize.py").write_text(
        "import os, mujoco\nclass GLContext:\n    def __init__(self, *a): os.abort()\nmujoco.GLContext = GLContext\n")
    monkeypatch.setenv("PYTHONPATH", f"{broken}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    with pytest.raises(video.NoRenderer, match="ended with status -6"):
        video.render([clip(2)], tmp_path / "a.mp4", dt=0.05)


@pytest.mark.slow
def test_unwritable_video_is_an_error(tmp_path):
    try:
        video.render([clip(2)], tmp_path / "ok.mp4", dt=0.05, size=(64, 64))
    except video.NoRenderer as error:
        pytest.skip(str(error))
    (tmp_path / "dir.mp4").mkdir()
    with pytest.raises(UserError, match="cannot write .*dir.mp4"):
        video.render([clip(2)], tmp_path / "dir.mp4", dt=0.05, size=(64, 64))


def test_the_rendering_process_loads_neither_torch_nor_warp():
    code = (
        "import sys; from dexsim.view import decor, live_panels, overlay, render;"
        " assert not {'torch', 'warp'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_tiles_fill_a_grid():
    tiles = [np.full((4, 6, 3), k, np.uint8) for k in range(1, 6)]
    whole = render.grid(tiles)
    assert whole.shape == (8, 18, 3)
    assert whole[0, 0, 0] == 1 and whole[0, 17, 0] == 3 and whole[7, 0, 0] == 4 and whole[7, 17, 0] == 24
    assert render.grid(tiles[:1]).shape == (4, 6, 3)


def test_bars_follow_force_and_command():
    blank = np.zeros((300, 300, 3), np.uint8)

    def blue(force):
        image = overlay.annotate(blank, force=force, names=("thumb",), full=10.0)
        return (np.abs(image.astype(int) - overlay.BAR).sum(2) < 10).sum()

    half, whole = blue([5.0]), blue([10.0])
    assert whole == pytest.approx(2 * half, rel=0.05) and blue([99.0]) == whole
    assert blue([0.0]) == blue([math.nan]) < 0.1 * half
    assert not blank.any()


def test_a_frame_is_not_covered():
    frame = np.random.default_rng(0).integers(0, 255, (280, 300, 3), np.uint8)
    above, below = overlay.room(280, True, True)
    whole = overlay.annotate(frame, "a title", [1.0, 2.0], 1.5, ("thumb", "mid"), 10.0)
    assert whole.shape == (280 + above + below, 300, 3) and (whole[above : above + 280] == frame).all()
    for drawn in (whole[:above], whole[above + 280 :]):
        assert (drawn != overlay.DARK).any()
    assert (overlay.annotate(frame) == frame).all()


def test_gravity_turns_to_straight_down():
    for gravity in ([0.0, 0.0, -9.81], [0.0, 0.0, 9.81], [3.0, -2.0, 1.0], [9.81, 0.0, 0.0]):
        turn = decor.turn_down(np.array(gravity))
        assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-12) and np.linalg.det(turn) == pytest.approx(1)
        assert turn @ gravity / np.linalg.norm(gravity) == pytest.approx([0, 0, -1], abs=1e-12)


@pytest.mark.slow
def test_a_push_shows_and_taxels_light(tmp_path):
    """An arrow is drawn while a force acts; a pad's picture changes where its taxels feel something."""
    points = np.array([[[0.0, 0.0, 0.01], [0.0, 0.01, 0.01], [0.01, 0.0, 0.01]]])
    normal = np.tile([0.0, 0.0, 1.0], (1, 3, 1))
    layout = SimpleNamespace(point=points, normal=normal, ty=np.tile([0.0, 1.0, 0.0], (1, 3, 1)), count=np.array([3]),
                             bodies=("object",))  # fmt: skip
    push, taxels = np.zeros((7, 3)), np.zeros((7, 1, 3))
    push[4:, 0], taxels[4:] = 3.0, 0.3
    model = mujoco.MjModel.from_xml_string(XML.replace("<body", '<body name="object"', 1))
    made = clip(force=np.ones((7, 1)), push=push, taxels=taxels, layout=layout, decor=True)
    made.model = model
    try:
        video.render([made], tmp_path / "a.mp4", dt=0.05, size=(320, 320), names=("thumb",))
    except video.NoRenderer as error:
        pytest.skip(str(error))
    _, frames = read(tmp_path / "a.mp4")
    above, below = overlay.room(320, False, True)
    scene = slice(above, 320 - below)
    assert np.abs(frames[6][320 - below :].astype(int) - frames[2][320 - below :]).max() > 60
    made.push[:] = 0
    video.render([made], tmp_path / "b.mp4", dt=0.05, size=(320, 320), names=("thumb",))
    _, without = read(tmp_path / "b.mp4")
    assert np.abs(frames[6][scene].astype(int) - without[6][scene]).max() > 60
    assert np.abs(frames[2][scene].astype(int) - without[2][scene]).max() < 40


def test_clips_of_an_evaluation():
    model = mujoco.MjModel.from_xml_string(XML)
    frames = {"model": [model, model], "qpos": [np.zeros((3, 7))] * 2, "overlay": [{"force": np.ones((3, 5))}, {}],
              "label": ["a", "b"]}
    first, second = video.clips_of(frames)
    assert first.force.shape == (3, 5) and first.command is None and first.label == "a" and second.force is None
    assert video.clips_of({"model": [model], "qpos": [np.zeros((3, 7))]})[0].label == ""


def test_curves_skip_empty_columns_and_keep_gaps(tmp_path):
    (tmp_path / "progress.csv").write_text("iteration,steps,reward,reward/near,never\n1,10,,1.0,\n2,20,3.0,2.0,\n")
    columns = plots.read_progress(tmp_path / "progress.csv")
    assert math.isnan(columns["reward"][0]) and columns["reward"][1] == 3.0
    path = plots.curves(columns, tmp_path / "curves.png", "title")
    assert path.read_bytes()[:4] == b"\x89PNG"
    assert plots.smooth([1.0, 2.0, 3.0, 4.0], 2) == [1.0, 1.5, 2.5, 3.5]
    with pytest.raises(UserError, match="no such file"):
        plots.read_progress(tmp_path / "none.csv")


def test_curves_as_a_command(tmp_path):
    (tmp_path / "progress.csv").write_text("iteration,steps,reward\n1,10,1.0\n2,20,3.0\n")
    done = subprocess.run([sys.executable, "-m", "dexsim.view.plots", str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0 and (tmp_path / "curves.png").exists(), done.stderr


def test_drawing_functions_give_one_file_each(tmp_path):
    def force_command(axes):
        axes.plot([0, 1], [0, 1])

    paths = plots.draw([force_command, ("plain", lambda axes: axes.plot([1]))], tmp_path)
    assert [p.name for p in paths] == ["force_command.png", "plain.png"]


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_a_drawn_figure_gives_its_memory_back_at_once(tmp_path):
    """Without Python's search for circles: ten hold 50 MB otherwise, and hundreds in a long run."""
    import gc

    from tests.soak.watch import look

    def draw(count):
        plots.draw([(f"{k}", lambda axes: axes.plot(range(500))) for k in range(count)], tmp_path)

    draw(2)
    gc.collect()
    gc.disable()
    try:
        before = look(os.getpid())[0]
        draw(10)
        assert look(os.getpid())[0] - before < 10
    finally:
        gc.enable()
