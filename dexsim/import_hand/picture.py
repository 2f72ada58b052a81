"""The picture of a hand that was read: palm's frame, joints and tips, where objects are let fall, open and cupped,
collision shapes, pads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dexsim import files
from dexsim.hand import Hand
from dexsim.hand.places import places
from dexsim.import_hand.geometry import posed
from dexsim.view.stills import Shot, render

AXES = (("x forward", "#d62728"), ("y", "#2ca02c"), ("z normal", "#1f77b4"))
VIEWS = (("onto the palm", 0.0, -89.0), ("from the fingers' side", 140.0, -25.0), ("from its side", 90.0, -5.0))
LABEL = {
    "fontsize": 6.5,
    "color": "black",
    "bbox": {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.75},
}


def qpos(hand: Hand, model: mujoco.MjModel, angles: np.ndarray) -> np.ndarray:
    """Return joint angles [J] in the hand's order as the model's qpos [nq]."""
    data = mujoco.MjData(model)
    hand.couplings.put(data, angles)
    return data.qpos.copy()


def panel(axes: Any, image: np.ndarray, title: str, fontsize: float = 9) -> None:
    """Draw an image with its title, nothing around it."""
    axes.imshow(image)
    axes.set(xticks=[], yticks=[], xlim=(0, image.shape[1]), ylim=(image.shape[0], 0))
    axes.set_title(title, fontsize=fontsize)


def bounds(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, float]:
    """Return middle [3] m of what is drawn, and the radius [m] of a sphere that holds it."""
    spheres = [(data.geom_xpos[g], model.geom_rbound[g]) for g in range(model.ngeom)]
    low = np.min([c - r for c, r in spheres], axis=0)
    high = np.max([c + r for c, r in spheres], axis=0)
    return 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))


def draw(hand: Hand, path: Path) -> None:
    """Write the picture (PNG). Raises `dexsim.view.video.NoRenderer` where nothing can be rendered."""
    from matplotlib.figure import Figure

    model = hand.spec().compile()
    poses = {name: qpos(hand, model, hand.pose(name)) for name in ("open", "cupped")}
    data = {name: posed(model, q) for name, q in poses.items()}
    middle, radius = bounds(model, data["open"])
    far = 2.6 * radius
    shots, titles = [], []
    for name in ("open", "cupped"):
        for what, azimuth, elevation in VIEWS:
            away = far * (1.15 if elevation < -80 else 1.0)
            shots.append(Shot(0, poses[name], middle, away, azimuth, elevation))
            titles.append(f"{name}, {what}")
    shots.append(Shot(0, poses["cupped"], middle, far, 140.0, -25.0, groups=(3,)))
    titles.append("collision shapes, cupped")
    for finger in hand.fingers if hand.touches else ():
        body = model.body(finger.body).id
        turn = data["open"].xmat[body].reshape(3, 3)
        at, normal = data["open"].xpos[body] + turn @ np.array(finger.position), turn @ np.array(finger.normal)
        azimuth = float(np.degrees(np.arctan2(-normal[1], -normal[0])))
        elevation = float(np.clip(np.degrees(np.arcsin(np.clip(-normal[2], -1, 1))), -89, 89))
        shots.append(Shot(0, poses["open"], at, 0.35 * radius, azimuth, elevation, (320, 320)))
        titles.append(f"pad of {finger.name}")
    images = render([model], shots)
    columns = 3
    rows = -(-len(shots) // columns)
    figure = Figure(figsize=(4.6 * columns, 3.9 * rows), dpi=100, layout="constrained")
    for k, (shot, image, title) in enumerate(zip(shots, images, titles, strict=True)):
        axes = figure.add_subplot(rows, columns, k + 1)
        panel(axes, image, title)
        d = data["open" if k < 3 or k > 6 else "cupped"]
        if k < 6:
            _frame(axes, shot, 0.35 * radius)
            _tips(axes, shot, hand, model, d)
        if k < 3:
            _catch(axes, shot, hand)
        if k == 0:
            _joints(axes, shot, hand, model, d)
        if k > 6:
            _taxels(axes, shot, hand, model, d, k - 7)
    thumbs = ", ".join(hand.fingers[k].name for k in hand.opposing)
    figure.suptitle(
        f"{hand.name}: {len(hand.joints)} joints, {len(hand.fingers)} fingers ({thumbs} opposing),"
        f" {hand.file.handedness} hand; span {1e3 * hand.span:.0f} mm",
        fontsize=12,
    )
    files.picture(figure, path)


def draw_skin(hand: Hand, path: Path) -> None:
    """Write the picture (PNG) of all taxels on the open hand, a colour a pad, from three sides: those that look at the
    camera. Raises `dexsim.view.video.NoRenderer` where nothing can be rendered."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    from dexsim.tactile.layout import hand_layout  # which brings torch and warp, seconds that a plain import is without

    model, layout = hand.spec().compile(), hand_layout(hand)
    assert layout is not None  # asked for only with touch
    q = qpos(hand, model, hand.pose("open"))
    data = posed(model, q)
    middle, radius = bounds(model, data)
    shots = [Shot(0, q, middle, 2.8 * radius, azimuth, elevation, (720, 640)) for _, azimuth, elevation in VIEWS]
    figure = Figure(figsize=(19.5, 6.6), dpi=100, layout="constrained")
    colours = colormaps["tab20"].colors  # type: ignore[attr-defined]
    for k, (shot, image) in enumerate(zip(shots, render([model], shots), strict=True)):
        axes = figure.add_subplot(1, len(shots), k + 1)
        panel(axes, image, f"open, {VIEWS[k][0]}")
        az, el = np.radians(shot.azimuth), np.radians(shot.elevation)
        ahead = np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])
        for f, name in enumerate(layout.names):
            n, b = int(layout.count[f]), model.body(layout.bodies[f]).id
            turn = data.xmat[b].reshape(3, 3)
            facing = layout.normal[f, :n] @ turn.T @ ahead < 0.0
            at = shot.project(layout.point[f, :n] @ turn.T + data.xpos[b])[facing]
            axes.plot(*at.T, ".", ms=5, color=colours[f % 20], label=f"{name}: {n}")
        if k == 0:
            axes.legend(fontsize=7, loc="upper left", framealpha=0.8)
    figure.suptitle(f"{hand.name}: {int(layout.count.sum())} taxels in {layout.pads} pads", fontsize=12)
    files.picture(figure, path)


def _frame(axes: Any, shot: Shot, length: float) -> None:
    ends = shot.project(np.vstack([np.zeros(3), length * np.eye(3)]))
    for k, (name, colour) in enumerate(AXES):
        if np.linalg.norm(ends[k + 1] - ends[0]) < 8:  # it points at the camera
            continue
        axes.annotate("", ends[k + 1], ends[0], arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.8})
        axes.text(*ends[k + 1], name, fontsize=7, color=colour, weight="bold", clip_on=True)


def _catch(axes: Any, shot: Shot, hand: Hand) -> None:
    """Draw a cross on the palm where objects are let fall over it."""
    at = shot.project(places(hand).catch[None])[0]
    axes.plot(*at, "x", ms=7, mew=1.8, color="#e64bd0")
    axes.text(at[0] + 6, at[1] + 4, "catch", fontsize=7, color="#e64bd0", weight="bold", clip_on=True)


def _tips(axes: Any, shot: Shot, hand: Hand, model: mujoco.MjModel, d: mujoco.MjData) -> None:
    for finger in hand.fingers:
        body = model.body(finger.body).id
        turn = d.xmat[body].reshape(3, 3)
        at = d.xpos[body] + turn @ np.array(finger.position)
        ends = shot.project(np.stack([at, at + 0.25 * np.linalg.norm(hand.span) * turn @ np.array(finger.normal)]))
        axes.plot(*ends[0], "o", ms=4, color="#ff7f0e")
        axes.annotate("", ends[1], ends[0], arrowprops={"arrowstyle": "->", "color": "#ff7f0e", "lw": 1.3})


def _joints(axes: Any, shot: Shot, hand: Hand, model: mujoco.MjModel, d: mujoco.MjData) -> None:
    """Write joint names beside the picture, each with a line to its joint."""
    at = shot.project(np.array([d.xanchor[model.joint(j).id] for j in hand.joints]))
    width, height = shot.size
    on_left = at[:, 0] < np.median(at[:, 0])
    for side, x, align in ((on_left, 4, "left"), (~on_left, width - 4, "right")):
        order = np.flatnonzero(side)[np.argsort(at[side, 1])]
        for slot, k in enumerate(order):
            y = height * (slot + 0.7) / (len(order) + 0.4)
            axes.plot([x, at[k, 0]], [y, at[k, 1]], color="black", lw=0.4, alpha=0.6)
            axes.plot(*at[k], "o", ms=2.5, color="black")
            axes.text(x, y, hand.joints[k], ha=align, va="center", **LABEL)


def _taxels(axes: Any, shot: Shot, hand: Hand, model: mujoco.MjModel, d: mujoco.MjData, k: int) -> None:
    finger = hand.fingers[k]
    assert finger.pad is not None
    from dexsim.tactile.layout import load_layout

    pad = load_layout(hand.folder / finger.pad.taxels, finger.body)
    body = model.body(finger.body).id
    turn = d.xmat[body].reshape(3, 3)
    points = pad["point"] @ turn.T + d.xpos[body]
    at, ends = shot.project(points), shot.project(points + 0.002 * pad["normal"] @ turn.T)
    axes.plot(*at.T, ".", ms=4, color="#d62728")
    for a, b in zip(at, ends, strict=True):
        axes.plot(*np.stack([a, b]).T, lw=0.7, color="#d62728")
    axes.set_xlabel(f"{len(points)} taxels, {1e4 * pad['area'].sum():.2f} cm2", fontsize=8)
