"""Touch on any link: taxels spread evenly over its surface (`dexsim import-hand skin`, `import-hand ... skin=`)."""

from __future__ import annotations

import difflib
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from dexsim import typed, yaml_text
from dexsim.errors import UserError
from dexsim.hand import Hand, load_hand
from dexsim.hand.schema import FILE
from dexsim.import_hand import corrections
from dexsim.import_hand import folder as folders
from dexsim.import_hand.frame import unit
from dexsim.import_hand.geometry import path
from dexsim.import_hand.taxels import Pad
from dexsim.import_hand.text import write
from dexsim.surface import across, geom_surface
from dexsim.surface import spread as spread_over

USAGE = """usage: dexsim import-hand skin FOLDER skin=LINK:TAXELS,... [out=FOLDER2] [picture=true]

Give links of a hand touch pads, as its fingertips have: FOLDER/skin_*.csv, entries in hand.yaml, hand_skin.png.

  skin=palm:80            80 taxels over the palm's palmar side
  skin=palm:4mm           one on every 4 x 4 mm
  skin=palm:80/4          in four pads
  skin=palm:80:all        its back and sides too
  skin=links:20           20 on each link of each finger but the fingertips
  skin=thumb_2:20         on the second link of the finger thumb; a body of the model by its name
  out=FOLDER2             a new hand, with links to the old one's files (default: FOLDER itself)
"""
MOST = 2000
"""Taxels of a hand's skin."""
SAMPLES, FEWEST, DENSEST = 250, 3000, 60_000
"""Points of a surface looked at: so many a taxel, at least, at most."""
ROOM = 0.01
"""m that a surface must have before it to be touched: less, and no object fits in."""
FLAT = 0.05
"""Cosine from which a normal looks out of the palmar side: sides that stand upright do not."""
TURNS = 25
"""Times that taxels move to the middle of what they stand for."""


@dataclass(frozen=True)
class Wish:
    """Hold what is asked of a link, by name: taxels, or the spacing [m] that gives them; pads; side: palmar or all."""

    link: str
    count: int | None
    spacing: float | None
    pads: int
    side: str


def wishes(text: str) -> list[Wish]:
    """Read `skin=`. Raises UserError naming the part, and what it must be."""
    out = []
    for part in str(text).split(","):
        link, _, rest = part.strip().partition(":")
        amount, _, side = rest.partition(":")
        amount, _, pads = amount.partition("/")
        where = f"skin={part.strip()}"
        if not link or not amount or side not in ("", "palmar", "all"):
            raise UserError(
                f"{where}: must be LINK:TAXELS, LINK:SPACINGmm, LINK:TAXELS/PADS, each with :all behind it for the"
                " whole surface; e.g. palm:80/4,links:20"
            )
        spacing = typed.number(where, amount.removesuffix("mm"), 0.5, 50.0, "mm") if amount.endswith("mm") else None
        count = None if spacing is not None else typed.whole(where, amount, 1, MOST)
        out.append(
            Wish(link, count, spacing and 1e-3 * spacing, typed.whole(where, pads or "1", 1, 64), side or "palmar")
        )
    return out


def names(hand: Hand) -> dict[str, str]:
    """Return short names of the links that press objects, fingertips' own shapes left out, and their bodies: palm; of a
    finger its name and the link's number from the root; else the body's name."""
    model, out = hand.compiled, {}
    for body in hand.links:
        name = "palm" if body == hand.palm_body else body
        for finger in hand.fingers:
            way = _way(model, finger.body, hand.palm_body)
            if body in way and sum(body in _way(model, f.body, hand.palm_body) for f in hand.fingers) == 1:
                name = f"{finger.name}_{way.index(body) + 1}"
        out[name] = body
    return out


def _way(model: mujoco.MjModel, tip: str, palm: str) -> list[str]:
    """Return names of the bodies from the palm, without it, to the tip."""
    way = [model.body(b).name for b in path(model, model.body(tip).id)]
    return way[way.index(palm) + 1 if palm in way else 1 :]


def lay(hand: Hand, requested: str) -> dict[str, tuple[str, Pad]]:
    """Make pads by name, each with its body. Raises UserError for links that are not there, or carry nothing on that
    side, and for more than MOST taxels."""
    known = names(hand)
    every, palm = hand.compiled, hand.palm_body
    out: dict[str, tuple[str, Pad]] = {}
    todo = []
    for wish in wishes(requested):
        tips = set(hand.tip_bodies)
        links = [n for n, b in known.items() if b != palm and b not in tips] if wish.link == "links" else [wish.link]
        for link in links:
            name = next((n for n, b in known.items() if link in (n, b)), None)
            if name is None:
                near = difflib.get_close_matches(link, known, 1)
                raise UserError(
                    f"skin={link}: no link of {hand.name} with a shape of its own that presses objects; there are"
                    f" {', '.join(known)}, and links for all of the fingers'"
                    + (f"; did you mean {near[0]}?" if near else "")
                )
            todo.append((name, wish))
    few = f"skin={requested}: {{}} taxels, at most {MOST} on a hand; ask for fewer or a wider spacing"
    if (total := sum(wish.count or 0 for _, wish in todo)) > MOST:
        raise UserError(few.format(total))
    for name, wish in todo:
        body = known[name]
        pads = _lay_link(hand, every, body, wish, f"skin={wish.link}")
        for k, pad in enumerate(pads):
            key = name if len(pads) == 1 else f"{name}_{'abcdefghijklmnopqrstuvwxyz'[k % 26]}{k // 26 or ''}"
            if key in out or key in hand.finger_names:
                raise UserError(f"skin={wish.link}: {key} is asked for twice; name a link once, as {name}:TAXELS/PADS")
            out[key] = body, pad
    total = sum(len(pad.point) for _, pad in out.values())
    if total > MOST:
        raise UserError(few.format(total))
    return out


def _lay_link(hand: Hand, m: mujoco.MjModel, body: str, wish: Wish, where: str) -> list[Pad]:
    """Make the pads of one link."""
    out_of_palm, ahead = directions(hand, body)
    points, normals, weight = _surface(hand, m, body, wish)
    seen = normals @ out_of_palm > FLAT if wish.side == "palmar" else np.ones(len(points), bool)
    points, normals, area = points[seen], normals[seen], weight * seen.sum()
    if len(points) < 20:
        raise UserError(f"{where}: {body} has no surface on its palmar side; {wish.link}:...:all takes every side")
    count = wish.count or max(1, round(area / wish.spacing**2))  # type: ignore[operator]  # one of the two is given
    if not wish.pads <= count <= min(MOST, len(points) // 8):
        raise UserError(
            f"{where}: {count} taxels in {wish.pads} pads on {1e4 * area:.1f} cm2; must be {wish.pads} to"
            f" {min(MOST, len(points) // 8)}"
        )
    # a thin link's two sides are not beside each other
    turned = np.sqrt(area / count) * normals
    chosen, owner = spread(np.concatenate([points, turned], 1), count)
    share = np.bincount(owner, minlength=count) / len(points)
    normal = unit(np.stack([np.bincount(owner, normals[:, k], count) for k in range(3)], 1))
    point = points[chosen]
    pad_of = spread(point, wish.pads)[1]
    pads = []
    for k in range(wish.pads):
        mine = np.flatnonzero(pad_of == k)
        mine = mine[np.lexsort((point[mine] @ np.cross(out_of_palm, ahead), np.round(point[mine] @ ahead, 3)))]
        along = ahead - normal[mine] * (normal[mine] @ ahead)[:, None]
        flat = np.linalg.norm(along, axis=1) < 0.05
        along[flat] = np.cross(normal[mine][flat], np.cross(out_of_palm, ahead))
        pads.append(Pad(point[mine], normal[mine], unit(np.cross(along, normal[mine])), area * share[mine], 0))
    return pads


def spread(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Choose `count` of points [P, D] that stand for the same number each, evenly: farthest points first (Gonzalez
    1985), then each moved to the middle of the points nearest to it (Lloyd 1982). Returns their indices [count] and for
    each point which of them is nearest [P]."""
    first = int(np.argmin(np.sum((points - points.mean(0)) ** 2, 1)))
    chosen, away = [first], np.sum((points - points[first]) ** 2, 1)
    for _ in range(count - 1):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.sum((points - points[chosen[-1]]) ** 2, 1))
    at = points[chosen]
    for _ in range(TURNS):
        owner = cKDTree(at).query(points)[1]
        n = np.bincount(owner, minlength=count)
        sums = np.stack([np.bincount(owner, points[:, k], count) for k in range(points.shape[1])], 1)
        at = np.where(n[:, None] > 0, sums / np.maximum(n, 1)[:, None], at)
    index = np.array(chosen)
    taken = cKDTree(points).query(at)[1]
    if len(set(taken.tolist())) == count:  # else two have met: the farthest points stay
        index = taken
    return index, cKDTree(points[index]).query(points)[1]


def _surface(hand: Hand, m: mujoco.MjModel, body: str, wish: Wish) -> tuple[np.ndarray, np.ndarray, float]:
    """Return points [P, 3] m spread at random over what a link shows of its shapes, in its frame, unit normals [P, 3]
    out of it, and the area [m2] that a point stands for. Not shown is what lies in another shape of the hand in the
    open pose, or has one before it within ROOM."""
    data = mujoco.MjData(m)
    hand.couplings.put(data, hand.pose("open"))
    mujoco.mj_kinematics(m, data)
    solids = {g: geom_surface(m, g) for g in range(m.ngeom) if m.geom_contype[g] or m.geom_conaffinity[g]}
    own = [m.geom(name).id for name in hand.links[body]]
    areas = {g: float(np.linalg.norm(across(solids[g][0][solids[g][1]]), axis=1).sum() / 2) for g in own}
    wanted = SAMPLES * (wish.count or sum(areas.values()) / wish.spacing**2)  # type: ignore[operator]
    total = int(np.clip(wanted, FEWEST, DENSEST))
    at, turn = data.body(body).xpos, data.body(body).xmat.reshape(3, 3)
    planes = []
    for g, (vertices, _) in solids.items():
        b = m.geom_bodyid[g]
        world = vertices @ data.xmat[b].reshape(3, 3).T + data.xpos[b]
        planes.append((g, ConvexHull((world - at) @ turn).equations))
    points, normals = [], []
    for g in own:
        vertices, faces = solids[g]
        count = max(1, round(total * areas[g] / sum(areas.values())))
        p, chosen = spread_over(vertices[faces], count, np.random.default_rng(0))
        n = unit(across(vertices[faces])[chosen])
        n *= np.where(np.sum(n * (p - vertices.mean(0)), 1) < 0, -1.0, 1.0)[:, None]  # what collides is convex
        free = np.ones(len(p), bool)
        for other, plane in planes:
            if other != g:
                free[free] &= ~_hits(p[free], n[free], plane)
        points.append(p[free])
        normals.append(n[free])
    return np.concatenate(points), np.concatenate(normals), sum(areas.values()) / total


def _hits(points: np.ndarray, ways: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Tell which rays from points [P, 3] along ways [P, 3] meet a convex solid, of planes [K, 4] (outward normal,
    offset), within ROOM (Cyrus and Beck 1978)."""
    out = np.zeros(len(points), bool)
    near = np.flatnonzero((points @ planes[:, :3].T + planes[:, 3]).max(1) < ROOM)
    outside, slope = points[near] @ planes[:, :3].T + planes[:, 3], ways[near] @ planes[:, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        at = -outside / slope
    enter = np.where(slope < -1e-12, at, -np.inf).max(1)
    leave = np.where(slope > 1e-12, at, np.inf).min(1)
    missed = ((np.abs(slope) <= 1e-12) & (outside > 0)).any(1)
    out[near] = ~missed & (enter < np.minimum(leave, ROOM)) & (leave > 0)
    return out


def directions(hand: Hand, body: str) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors in a link's frame: out of its palmar side, and towards the fingertips. Of a finger's link:
    its fingertip's, the finger straight; else the palm's."""
    m = hand.compiled
    pose = hand.pose("open")
    bends = sorted({j for f in hand.fingers for j in f.flexion})
    pose[bends] = np.clip(0.0, *hand.limits[bends].T)
    data = mujoco.MjData(m)
    hand.couplings.put(data, pose)
    mujoco.mj_kinematics(m, data)
    here = data.body(body)
    normal, ahead = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    own = [f for f in hand.fingers if body in _way(m, f.body, hand.palm_body)]
    if len(own) == 1:
        tip = data.body(own[0].body)
        turn = tip.xmat.reshape(3, 3)
        normal, ahead = turn @ np.array(own[0].normal), tip.xpos + turn @ np.array(own[0].position) - here.xpos
    normal, ahead = (here.xmat.reshape(3, 3).T @ v for v in (normal, ahead))
    return normal, unit(ahead - normal * (normal @ ahead))


def write_pads(hand: Hand, folder: Path, requested: str, say: Callable[[str], None]) -> list[dict[str, str]]:
    """Write the pads that are asked for, skin_*.csv, and return their entries in hand.yaml. Raises UserError."""
    if not hand.touches:
        raise UserError(f"skin={requested}: needs pads on the fingertips, and hand {hand.name} has none (pads=8x6)")
    kind, out = hand.pads[hand.others[0]].kind, []
    for name, (body, pad) in lay(hand, requested).items():
        out.append({"name": name, "body": body, "taxels": f"skin_{name}.csv", "kind": kind})
        (folder / f"skin_{name}.csv").write_text(pad.csv(), encoding="ascii")
        say(f"skin     {name:<9}{len(pad.point):>4} taxels on {1e4 * pad.area.sum():.2f} cm2 of {body}")
    return out


def add(folder: Path, requested: str, say: Callable[[str], None] = lambda text: None) -> Hand:
    """Lay the skin that is asked for over the hand in a folder, in place of what it had: skin_*.csv, entries of
    hand.yaml. Returns the hand. Raises UserError, with nothing changed."""
    entries = write_pads(load_hand(folder), folder, requested, say)
    data, note = yaml_text.load(folder / FILE, "hand"), corrections.written(folder)
    for old in {e["taxels"] for e in data.get("skin") or []} - {e["taxels"] for e in entries}:
        (folder / old).unlink(missing_ok=True)
    write(data | {"skin": entries, "source": (data.get("source") or {}) | {"skin": requested}}, folder)
    if note is not None:  # so that the next import knows these files for its own
        note["files"] |= {e["taxels"]: folders.sha(folder / e["taxels"]) for e in entries}
        (folder / corrections.NOTE).write_text(json.dumps(note, indent=1), encoding="utf-8")
    return load_hand(folder)


def show(hand: Hand, folder: Path, say: Callable[[str], None]) -> None:
    """Write hand_skin.png, or say why not."""
    from dexsim.import_hand.picture import draw_skin
    from dexsim.view.video import drawn

    drawn(lambda: draw_skin(hand, folder / "hand_skin.png"), say, "no picture: ")


def main(argv: list[str]) -> int:
    """Return the exit status. Raises UserError."""
    hands, given = typed.words(argv, ("skin", "out", "picture"))
    if len(hands) != 1 or not given.get("skin"):
        print(USAGE, end="")
        return 2
    hand = load_hand(hands[0])
    out = Path(given["out"]).expanduser() if given.get("out") else hand.folder
    if out == hand.folder and hand.comes_along:
        raise UserError(f"hand={hand.name} comes with dexsim: say out=FOLDER, e.g. out=hands/{hand.name}_skin")
    if out != hand.folder:
        copy(hand, out)
    try:
        done = add(out, given["skin"], print)
    except UserError:
        if out != hand.folder:
            shutil.rmtree(out)
        raise
    if typed.truth("picture", given.get("picture", "true")):
        show(done, out, print)
    at = out.relative_to(Path.cwd()) if out.is_relative_to(Path.cwd()) else out
    print(f"{at}/{FILE}: {len(done.pads)} pads; look at {at}/hand_skin.png. dexsim train hand={at}")
    return 0


def copy(hand: Hand, out: Path) -> None:
    """Make a new folder with the files of a hand. Raises UserError where the folder holds anything."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"out={out}: exists and is not empty; choose another, or leave out= away for the hand itself")
    shutil.copytree(hand.folder, out, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    shutil.copy2(hand.servo_path, out / "servo.yaml")
    write(yaml_text.load(hand.folder / FILE, "hand") | {"name": out.name, "servo": "servo.yaml"}, out)
