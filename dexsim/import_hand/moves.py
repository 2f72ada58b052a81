"""`dexsim import-hand check FOLDER`: every joint in turn, through its range and back, told, filmed and drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dexsim import files, outputs, typed
from dexsim.hand import Hand, load_hand
from dexsim.import_hand import folder, picture
from dexsim.import_hand.frame import tip_at
from dexsim.import_hand.geometry import posed

USAGE = """usage: dexsim import-hand check FOLDER [out=FOLDER] [seconds=1] [film=true] [hand_mirror=true]

Move each joint of a hand through its range, from the open pose and back, and say what it does: how far it takes its
fingertip, whether a joint that should close the finger does, and where links touch. Writes check.png, each joint at
both its limits; with film=true also check.mp4 (seconds: of each joint's move). FOLDER may be a hand that comes with
dexsim (xhand; then with out=); hand_mirror=true checks its mirror image.
"""
STEPS = 25  # poses each way
STEP = (0.1, 0.25)  # of its range, that a joint closes: a tip near the others may go past them
RATE = 12  # pictures a second


@dataclass
class Move:
    """One joint moved alone. finger: index, -1: none; role: what hand.yaml says of it; travel: m that the fingertip
    goes between the limits; closer: m that it comes nearer to the fingers it presses against as the joint closes;
    touches: the first pair of links that overlap on the way, and the angle."""

    joint: str
    finger: int
    role: str
    travel: float
    closer: float
    touches: tuple[str, str, float] | None


def moves(hand: Hand) -> list[Move]:
    """Return every joint's move."""
    model = hand.spec().compile()
    data = mujoco.MjData(model)
    start = hand.pose("open")
    owner = {j: k for k, f in enumerate(hand.fingers) for j in f.joints}
    out = []

    def tips(q: np.ndarray) -> np.ndarray:
        hand.couplings.put(data, q)
        mujoco.mj_kinematics(model, data)
        return np.array([tip_at(data, model.body(f.body).id, np.array(f.position)) for f in hand.fingers])

    def overlap() -> tuple[str, str] | None:
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        for c in data.contact[: data.ncon]:
            if c.dist < -0.001:
                a, b = (model.body(model.geom_bodyid[g]).name for g in c.geom)
                return a, b
        return None

    for j, name in enumerate(hand.joints):
        finger = owner.get(j, -1)
        first = None
        for angle in np.linspace(hand.limits[j][0], hand.limits[j][1], STEPS):
            q = start.copy()
            q[j] = angle
            tips(q)
            if first is None and (pair := overlap()) is not None:
                first = (*pair, float(angle))
        role, closer = "turns", 0.0
        ends = []
        for angle in hand.limits[j]:
            q = start.copy()
            q[j] = angle
            ends.append(tips(q))
        travel = float(np.linalg.norm(ends[1][finger] - ends[0][finger])) if finger >= 0 else 0.0
        if finger >= 0 and j in hand.fingers[finger].flexion:
            sign = hand.fingers[finger].closes[hand.fingers[finger].flexion.index(j)]
            role = f"bends, closes to {'+' if sign > 0 else '-'}"
            goal = hand.others if finger in hand.opposing else hand.opposing
            now, after = tips(start), []
            for share in STEP:
                q = start.copy()
                q[j] = np.clip(start[j] + sign * share * np.ptp(hand.limits[j]), *hand.limits[j])
                after.append(tips(q)[finger])
            # a claw's finger closes on the middle of the others, which may lead off the one that opposes it
            others = [list(goal), [k for k in range(len(hand.fingers)) if k != finger]]
            middles = [now[group].mean(0) for group in others]
            far = [[float(np.linalg.norm(tip - x)) for tip in (now[finger], *after)] for x in middles]
            closer = max(d[0] - min(d[1:]) for d in far)
        out.append(Move(name, finger, role, travel, closer, first))
    return out


def main(argv: Sequence[str]) -> int:
    """Run the command; return the exit status: 1 where a joint that should close its finger opens it. Raises
    UserError."""
    if not argv or any(a in ("-h", "--help", "help") for a in argv):
        print(USAGE, end="")
        return 0 if argv else 2
    given = typed.settings(argv[1:], ("out", "seconds", "film", "hand_mirror"))
    seconds = typed.number("seconds", given.get("seconds", "1"), 0.2, 20.0, "s of each joint's move")
    film, mirror = (typed.truth(key, given.get(key, "false")) for key in ("film", "hand_mirror"))
    hand = load_hand(argv[0], mirror)
    out = Path(given.get("out") or hand.folder).expanduser()
    outputs.claim(out, "out=", folder.SHOWN[: 1 + film])
    table = moves(hand)
    wide = max(22, *(len(m.joint) + 2 for m in table))
    print(
        f"{'joint':<{wide}}{'finger':<10}{'what it does':<21}{'rad (slides m)':>15}{'tip goes':>10}{'closing':>10}"
        "  links that touch"
    )
    for k, m in enumerate(table):
        low, high = hand.limits[k]
        finger = hand.fingers[m.finger].name if m.finger >= 0 else "-"
        closing = f"{1e3 * m.closer:+.0f} mm" if m.role.startswith("bends") else ""
        touch = f"{m.touches[0]}, {m.touches[1]} at {m.touches[2]:.2f}" if m.touches else ""
        print(
            f"{m.joint:<{wide}}{finger:<10}{m.role:<21}{f'{low:.3g} to {high:.3g}':>15}{1e3 * m.travel:>7.0f} mm"
            f"{closing:>10}  {touch}"
        )
    for text in faults(table):
        print(f"check: {text}")
    with outputs.staged(out) as stage:
        made = _show(hand, stage, seconds, film)
    for name in made:
        print(out / name)
    return 1 if any(_opens(m) for m in table) else 0


def faults(table: Sequence[Move]) -> list[str]:
    """Return a line for each joint that does not do what hand.yaml says of it."""
    still = [f"{m.joint} does not move its fingertip: is tip.body right?" for m in table
             if m.finger >= 0 and m.travel < 0.001]  # fmt: skip
    return still + [
        f"{m.joint} takes its fingertip away from those it presses against as it closes: turn its sign in"
        " closes, or take it out of flexion"
        for m in table
        if _opens(m)
    ]


def _opens(m: Move) -> bool:
    return m.role.startswith("bends") and m.closer < -0.002


def _show(hand: Hand, out: Path, seconds: float, film: bool) -> list[str]:
    """Make the film and the sheet of pictures; return which of them could be made."""
    from dexsim.view import video

    model = hand.spec().compile()
    start = hand.pose("open")
    data = posed(model, picture.qpos(hand, model, start))
    middle, radius = picture.bounds(model, data)
    camera: dict[str, Any] = {"lookat": middle.tolist(), "distance": 2.6 * radius, "azimuth": 140.0, "elevation": -25.0}
    made = []
    try:
        _sheet(hand, model, start, camera, out / "check.png")
        made.append("check.png")
        if film:
            rows, text = [], []
            count = max(8, int(seconds * RATE))
            for j, name in enumerate(hand.joints):
                low, high = hand.limits[j]
                s = np.linspace(0, 1, count)
                way = np.interp(s, [0, 0.2, 0.7, 1], [start[j], low, high, start[j]])
                for angle in way:
                    q = start.copy()
                    q[j] = angle
                    rows.append(picture.qpos(hand, model, q))
                    text.append(f"{name}: {angle:+.2f} rad")
            limit = int(60 * RATE)
            if len(rows) > limit:  # a video holds a minute
                keep = np.linspace(0, len(rows) - 1, limit).astype(int)
                rows, text = [rows[k] for k in keep], [text[k] for k in keep]
            clip = video.Clip(model, np.array(rows), hand.name, None, None, text)
            video.render(
                [clip], out / "check.mp4", 1.0 / RATE, size=(480, 368), camera=camera | {"distance": 2.1 * radius}
            )
            made.append("check.mp4")
    except video.NoRenderer as error:
        print(f"no pictures: {error}")
    return made


def _sheet(hand: Hand, model: mujoco.MjModel, start: np.ndarray, camera: dict[str, Any], path: Path) -> None:
    """Draw a row a joint: at its low end, open, at its high end."""
    from matplotlib.figure import Figure

    from dexsim.view.stills import Shot, render

    shots, titles = [], []
    for j, name in enumerate(hand.joints):
        for angle in hand.limits[j]:
            q = start.copy()
            q[j] = angle
            shots.append(Shot(0, picture.qpos(hand, model, q), **camera, size=(300, 250)))
            titles.append(f"{name} {angle:+.2f}")
    images = render([model], shots)
    columns = 6
    rows = -(-len(shots) // columns)
    figure = Figure(figsize=(2.6 * columns, 2.4 * rows), dpi=70, layout="constrained")
    for k, (image, title) in enumerate(zip(images, titles, strict=True)):
        picture.panel(figure.add_subplot(rows, columns, k + 1), image, title, 8)
    files.picture(figure, path)
