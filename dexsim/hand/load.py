"""Read a hand's folder and check that file and model agree."""

from __future__ import annotations

import copyreg
import difflib
import os
import re
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import numpy as np

from dexsim import files
from dexsim.errors import UserError
from dexsim.hand import derive, model, schema
from dexsim.hand.hand import Finger, Hand
from dexsim.hand.schema import FILE, HandFile, Pad

HANDS = Path(__file__).parents[1] / "assets"
"""Folders of the hands that come with dexsim."""
IMPORTED = "hands"
"""Folder of a user's own, in the working directory."""
NAMED = ("menagerie:", "robot_descriptions:")
"""Begin names of hands that others describe: imported once, below `hands/`."""
SCALES = (0.2, 5.0)


def load_hand(which: str | Path = "xhand", mirror: bool = False, scale: float = 1.0) -> Hand:
    """Return the hand of a folder (or of the hand.yaml in it), or by name one that comes with dexsim or lies in
    `hands/` here.

    mirror: its mirror image (a right hand becomes a left one); scale: all lengths times this, masses times its cube,
    motors unchanged. Raises UserError, one line: file, field, value, what must be there.
    """
    if isinstance(mirror, bool) is False:
        raise UserError(f"hand_mirror={mirror}: must be true or false")
    if isinstance(scale, bool) or not isinstance(scale, (int, float)) or not SCALES[0] <= scale <= SCALES[1]:
        raise UserError(f"hand_scale={scale}: must lie in [{SCALES[0]}, {SCALES[1]}]")
    path = _file(which)
    stamp = path.stat().st_mtime_ns
    return _load(path, stamp, mirror, float(scale))


def known() -> list[str]:
    """Names of the hands that come with dexsim."""
    return sorted(p.parent.name for p in HANDS.glob(f"*/{FILE}"))


def _imported() -> list[str]:
    """Names of the hands in `hands/` of the working directory, where the tutorial has them imported."""
    return sorted(p.parent.name for p in Path(IMPORTED).glob(f"*/{FILE}"))


def _file(which: str | Path) -> Path:
    text = str(which)
    if text in known():
        return HANDS / text / FILE
    path = files.place(text)
    if os.path.isfile(path / FILE):  # not Path's, which raises where a name is too long for a file
        return (path / FILE).resolve()
    if path.name == FILE and os.path.isfile(path):
        return path.resolve()
    if text in (mine := _imported()):
        return (Path(IMPORTED) / text / FILE).resolve()
    if text.startswith(NAMED):
        folder = Path(IMPORTED) / re.sub(r"\W+", "_", text.partition(":")[2])
        if folder.name not in mine:
            _import(text, folder)
        return (folder / FILE).resolve()
    names = list(dict.fromkeys((*known(), *mine)))
    near = difflib.get_close_matches(text, names, 1)
    raise UserError(
        f"hand={text}: must be one of {', '.join(names)}, or a folder with a {FILE}"
        + (f"; did you mean {near[0]}?" if near else "")
        + (f"; {path} has no {FILE}: write one, {schema.SEE}" if os.path.isdir(path) else "")
    )


def _import(text: str, folder: Path) -> None:
    """Import a named hand as its user would, in a process of its own."""
    print(f"hand={text}: imported once, into {folder} ...", flush=True)
    words = [sys.executable, "-m", "dexsim", "import-hand", text, f"out={folder}"]
    done = subprocess.run(words, stderr=subprocess.PIPE, encoding="utf-8", errors="replace")
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"import-hand ended with {done.returncode}"]
        raise UserError(f"hand={text}: {lines[-1].removeprefix('error: ')}")


@lru_cache(maxsize=16)
def _load(path: Path, stamp: int, mirror: bool, scale: float) -> Hand:
    file = schema.read(path)
    where = f"hand {path}"
    for key, name in (("model", file.model), ("servo", file.servo)):
        if not (path.parent / name).is_file():
            raise UserError(f"{where}: {key} ({name}): no such file beside it; give a path relative to {path.parent}")
    _names(file, where)
    spec, tips = model.prepared(file, path, where)
    limits = model.limits(spec, [j.name for j in file.joints], where)
    _poses(file, limits, where)
    passive = [j.name for j in spec.joints if j.name not in {entry.name for entry in file.joints}]
    for name in file.sensed:
        if name not in passive:
            there = _near(name, passive) if passive else "every joint has one"
            raise UserError(f"{where}: sensed: '{name}' is no joint without a drive; {there}")
    if mirror or scale != 1.0:
        spec = derive.derived(spec, mirror, scale)
        limits = model.limits(spec, [j.name for j in file.joints], where)
    order = {j.name: k for k, j in enumerate(file.joints)}
    flip = np.array([1.0, -1.0 if mirror else 1.0, 1.0])
    fingers = []
    leader = next((f for f in file.fingers if f.flexion), None)
    if leader is None:
        raise UserError(f"{where}: fingers: none has a joint in flexion: name those that close a finger")
    for entry, geoms in zip(file.fingers, tips, strict=True):
        bends = entry if entry.flexion else leader  # one that follows another bends with it
        normal = np.array(entry.tip.normal) / np.linalg.norm(entry.tip.normal)
        fingers.append(
            Finger(
                name=entry.name, joints=tuple(order[j] for j in entry.joints),
                flexion=tuple(order[j] for j in bends.flexion), closes=tuple(bends.closes or [1] * len(bends.flexion)),
                root=model.root_body(spec, entry.joints, entry.tip.body, file.palm.body), body=entry.tip.body,
                position=_triple(np.array(entry.tip.position) * flip * scale), normal=_triple(normal * flip),
                geoms=geoms, pad=entry.pad,
            )
        )
    names = [f.name for f in file.fingers]
    opposing = tuple(names.index(f) for f in file.opposing)
    hand = Hand(
        folder=path.parent, file=file, mirror=mirror, scale=scale, joints=tuple(order), fingers=tuple(fingers),
        limits=limits, efforts=np.array([j.effort for j in file.joints]),
        speeds=np.array([j.speed for j in file.joints]), opposing=opposing,
        others=tuple(k for k in range(len(names)) if k not in opposing), span=file.span * scale,
        force=float(file.force) if isinstance(file.force, (int, float)) else file.force, _spec=spec,
    )  # fmt: skip
    presses = {*hand.links, *hand.tip_bodies}
    for pad in file.skin:
        if pad.body not in presses:
            raise UserError(
                f"{where}: skin.{pad.name}.body ({pad.body}): no link whose geoms press objects;"
                f" {_near(pad.body, sorted(presses))}"
            )
    return hand


def _triple(v: np.ndarray) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


def _twice(names: list[str]) -> str | None:
    return next((n for k, n in enumerate(names) if n in names[:k]), None)


def _names(file: HandFile, where: str) -> None:
    """Return what can be told without the model."""
    joints, fingers = [j.name for j in file.joints], [f.name for f in file.fingers]
    for key, names in (
        ("joints", joints), ("fingers", fingers), ("fingers.*.tip.body", [f.tip.body for f in file.fingers]),
        ("fingers.*.joints", [j for f in file.fingers for j in f.joints]), ("opposing", file.opposing),
        ("skin and fingers", [*fingers, *(p.name for p in file.skin)]),
    ):  # fmt: skip
        if (twice := _twice(names)) is not None:
            raise UserError(f"{where}: {key}: '{twice}' twice; each must be there once")
    for f in file.fingers:
        for j in f.joints:
            if j not in joints:
                raise UserError(f"{where}: fingers.{f.name}.joints: '{j}' is not in joints; {_near(j, joints)}")
        for j in f.flexion:
            if j not in f.joints:
                raise UserError(f"{where}: fingers.{f.name}.flexion: '{j}' is not among its joints {f.joints}")
        if _twice(f.flexion) is not None or f.flexion != [j for j in f.joints if j in f.flexion]:
            raise UserError(f"{where}: fingers.{f.name}.flexion ({f.flexion}): must be in the order of its joints")
        if f.closes is not None and len(f.closes) != len(f.flexion):
            raise UserError(
                f"{where}: fingers.{f.name}.closes ({f.closes}): must have {len(f.flexion)} entries, one of +1 or -1"
                " for each joint of flexion"
            )
        if not np.linalg.norm(f.tip.normal) > 1e-6:
            raise UserError(f"{where}: fingers.{f.name}.tip.normal ({f.tip.normal}): must have a length")
    for name in file.opposing:
        if name not in fingers:
            raise UserError(f"{where}: opposing: '{name}' is not a finger; {_near(name, fingers)}")
    if len(file.opposing) == len(fingers):
        raise UserError(f"{where}: opposing names every finger; leave out those that they press against")
    _pads([f.pad for f in file.fingers], fingers, bool(file.skin), where)
    forward, normal = np.array(file.palm.forward), np.array(file.palm.normal)
    if not np.linalg.norm(np.cross(normal, forward)) > 0.1 * np.linalg.norm(normal) * np.linalg.norm(forward) > 0:
        raise UserError(
            f"{where}: palm.forward ({file.palm.forward}), palm.normal ({file.palm.normal}): must have lengths and"
            " differ in direction by 6 degrees or more; best at right angles"
        )


def _pads(pads: list[Pad | None], fingers: list[str], skin: bool, where: str) -> None:
    bare = [name for name, pad in zip(fingers, pads, strict=True) if pad is None]
    if bare and len(bare) < len(fingers):
        raise UserError(
            f"{where}: fingers.{bare[0]}.pad: has none, but others have; give every finger a pad, or none (pad: null)"
        )
    if bare and skin:
        raise UserError(f"{where}: skin: needs pads on the fingertips; fingers.{bare[0]}.pad is null")


def _near(name: str, names: list[str]) -> str:
    near = difflib.get_close_matches(name, names, 1)
    return f"did you mean {near[0]}?" if near else f"there are {', '.join(names[:12])}"


def _poses(file: HandFile, limits: np.ndarray, where: str) -> None:
    joints = [j.name for j in file.joints]
    for which in ("open", "cupped"):
        pose = getattr(file.poses, which)
        for j in pose:
            if j not in joints:
                raise UserError(f"{where}: poses.{which}: no joint '{j}'; {_near(j, joints)}")
        for j, (low, high) in zip(joints, limits, strict=True):
            if j not in pose:
                raise UserError(f"{where}: poses.{which}: lacks joint '{j}'; give an angle for each")
            if not low - 1e-6 <= pose[j] <= high + 1e-6:
                raise UserError(
                    f"{where}: poses.{which}.{j} ({pose[j]:g}): the model's range is [{low:.4g}, {high:.4g}] rad"
                )


def _reduced(hand: Hand) -> tuple[object, tuple[str, bool, float]]:
    """Return a hand as another process gets it, as its folder: MuJoCo's models being edited cannot be pickled."""
    return load_hand, (str(hand.folder), hand.mirror, hand.scale)


copyreg.pickle(Hand, _reduced)  # type: ignore[arg-type]
