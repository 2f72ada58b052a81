"""Uses of a damaged file: read, and used as far as the program uses it before any long work."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dexsim import yaml_text
from dexsim.actuator.table import ServoTable
from dexsim.assets.objects import own
from dexsim.calibration.file import Calibration
from dexsim.cli import settings, start
from dexsim.deploy import bundle
from dexsim.errors import UserError
from dexsim.gap.read import Run, channels, inputs
from dexsim.hand import load_hand
from dexsim.import_hand import source
from dexsim.paths import CONFIGS
from dexsim.recording import attached, metadata, read, write
from dexsim.recording.mechanism import Mechanism, mechanism
from dexsim.recording.readers import expanded
from dexsim.recording.schema import COMMANDS, STATES, Recording
from dexsim.tactile import file as tactile_file
from dexsim.tactile.layout import hand_layout
from tools.assets import xhand

from . import corpus, silence

MODEL = """<mujoco><worldbody><body><joint name="a" axis="0 1 0" range="-1 1" limited="true"/>
 <geom size=".02" mass=".1" pos="0 0 -.1"/>
<body pos="0 0 -.2"><joint name="b" axis="0 1 0"/><geom size=".02" mass=".1" pos="0 0 -.1"/></body></body></worldbody>
 </mujoco>"""
Told = set[tuple[str, str]]
"""(topic, kind) of what was said of a recording; topic "" of the whole."""
_sound: dict[str, Told] = {}


def recording(path: Path) -> str:
    used = _used(path)
    if used is None:
        return ""
    r, runs, reported = used
    for run in runs:
        run.smooth()
        assert np.isfinite(run.q).all() and np.isfinite(run.cmd).all() and (np.diff(run.t) > 0).all(), (
            "a run that cannot be simulated"
        )
    return silence.of_recording(path, r, runs, reported - _always())


def _used(path: Path) -> tuple[Recording, list[Run], Told] | None:
    """Return (what was read, the runs that a diagnosis would use, what it would say); None where it uses none, and
    says so."""
    r = read(path)
    spec = mujoco.MjSpec.from_string(MODEL)
    m = Mechanism(spec, corpus.JOINTS, ServoTable.from_dict(corpus.SERVO), "rig")
    notes: list[str] = []
    try:
        run = inputs.to_run(read(path, joints=m.joints), m, notes)
    except inputs.Unusable:
        return None
    model = spec.compile()
    found, out, blind = channels.inspect([run], model, channels.spoiled([r]))
    runs = channels.drop([run], out, notes, model)
    if blind:
        runs, _ = inputs.free_air(runs, [], inputs.merged_spans(blind), notes, "", "", (0.0, 0.0), inputs.SHORTEST)
    reported = {(f.topic, f.kind) for f in r.findings if f.severity != "info"}
    reported |= {(topic, "channel") for f in found for topic in f.topics} | {("", "pause") for _ in blind}
    for word, topic in (("position", STATES), ("command", COMMANDS)):
        reported |= {(topic, n) for n in notes if word in n}
    return r, runs, reported


def _always() -> Told:
    """Return what is said of a sound recording, too."""
    if not _sound:
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder) / "sound.mcap", corpus.recording())
            used = _used(Path(folder) / "sound.mcap")
        assert used is not None
        _sound["told"] = used[2]
    return _sound["told"]


def servo(path: Path) -> str:
    table = ServoTable.load(path)
    table.check_joints(corpus.JOINTS)
    for f in (table.nominal, table.bounds, table.unknown, table.current):
        f(corpus.JOINTS)
    for which in ("loop", "position"):
        table.encoder(which, corpus.JOINTS)
    taken = table.to_dict()
    ServoTable.from_dict(taken)
    return silence.of_settings(_said(path), taken)


def calibration(path: Path) -> str:
    c = Calibration.load(path)
    assert np.isfinite(c.torque_norm(np.ones(12))).all() and np.isfinite(c.normal_force(np.ones((5, 120, 3)))).all()
    taken, said = c.to_dict(), _said(path)
    Calibration.from_dict(taken)
    for joint, entry in (said.get("joints") or {}).items():  # what is unknown is assumed, and that is told
        for key in [k for k, v in (entry or {}).items() if v == "unknown"]:
            if c.normalization == "paper" or any(key in a and (joint in a or "every" in a) for a in c.assumed):
                del entry[key]
    return silence.of_settings(said, taken)


def tactile(path: Path) -> str:
    return silence.of_settings(_said(path), tactile_file.load(path))


def _said(path: Path) -> Any:
    return yaml_text.load(path, "what the file says")


def beside(path: Path) -> str:
    """Read it as the metadata file beside a recording."""
    path = path.rename(path.with_name("case.mcap.yaml"))
    stated, units, _ = metadata.collect(path.with_name("case.mcap"), {}, {})
    metadata.complete(stated, True, True)
    said = {key: metadata._text(value) for key, value in (_said(path) or {}).items()}
    return silence.of_settings(said, stated | {f"{key}_unit": unit for key, unit in units.items()})


def config(path: Path) -> str:
    attached.config(path.read_bytes().decode("utf-8", "replace"), "case")
    return ""


def hand(path: Path) -> str:
    """Read it as the hand.yaml of a folder with the xHand's other files, read as far as a training reads it."""
    folder = path.parent / "case_hand"
    folder.mkdir()
    grasps = xhand.FOLDER.parent / "grasps"
    for other in (*xhand.FOLDER.iterdir(), CONFIGS / "servo" / "xhand.yaml", *grasps.glob("*.npz")):
        if other.name != "hand.yaml":
            (folder / other.name).symlink_to(other)
    path.rename(folder / "hand.yaml")
    made = load_hand(folder)
    made.spec().compile()
    hand_layout(made)
    return ""


def object_(path: Path) -> str:
    """Return a mesh to grasp, or a folder of import-object."""
    if path.suffix == ".npz":
        folder = path.parent / "case_object"
        folder.mkdir()
        path = path.rename(folder / own.FILE).parent
    own.own_shape(str(path), parts=1)
    return ""


def checkpoint(path: Path) -> str:
    """Return the loaded, and its settings completed, as play does before it builds anything."""
    start.for_play([f"checkpoint={path}", "device=cpu"], CONFIGS)
    return ""


def manifest(path: Path) -> str:
    bundle.load(path)
    return ""


def overrides(path: Path) -> str:
    """Return the settings of a training, as far as they are checked before anything heavy begins."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    if any(line.lstrip("+~").startswith(("servo_file", "resume", "tactile_file", "model_file")) for line in lines):
        return ""
    with contextlib.redirect_stdout(io.StringIO()):
        made = start.for_train(lines, CONFIGS)
    return "" if made is None else _typed(lines, made.cfg)


def _typed(lines: list[str], cfg: dict[str, Any]) -> str:
    """Return the first typed setting that is another in the settings that a training would begin with."""
    requested = {}
    for override in settings.parse([x for x in lines if "=" in x and x[:1] not in "~+-"], CONFIGS).values:
        if not override.is_sweep_override():
            requested[override.key_or_group] = override.value()
    for key, value in requested.items():
        here: Any = cfg
        for part in key.split("."):
            here = here.get(part) if isinstance(here, dict) else None
        group = isinstance(here, dict) and not isinstance(value, dict)
        if group or any(other.startswith(f"{key}.") for other in requested):
            continue  # a group, or a part of it is typed, too
        found = silence.of_settings(value, here, key)
        if found:
            return found
    return ""


def dataset(path: Path) -> str:
    """Return the first episode of a data set, or a bag, read and audited."""
    read(expanded(path)[0])
    return ""


def network(path: Path) -> str:
    """Return a bundle's network."""
    bundle.load(path)
    return ""


def model(path: Path) -> str:
    """Return a model of MuJoCo's, as a diagnosis takes it."""
    m = mechanism(path, corpus.SERVO | {"joints": {"*": {"kp": 1.0}}, "loop_encoder": "motor", "current_per_torque": 1})
    m.spec.compile()
    return ""


def robot(path: Path) -> str:
    """Return the same, to be imported as a hand."""
    source.read(path)
    return ""


TARGETS: dict[str, Callable[[Path], str]] = {
    "recording": recording,
    "servo": servo,
    "calibration": calibration,
    "tactile": tactile,
    "metadata": beside,
    "config": config,
    "checkpoint": checkpoint,
    "manifest": manifest,
    "overrides": overrides,
    "hand": hand,
    "object": object_,
    "dataset": dataset,
    "network": network,
    "model": model,
    "robot": robot,
}


def verdict(kind: str, path: Path) -> str:
    """Return "fine", "refused", or what is wrong with how the file was answered ("silent: ..." where a file was taken
    for another than it is without a word)."""
    try:
        silent = TARGETS[kind](path)
    except UserError as error:
        text = str(error)
        if "\n" in text:
            return f"more than one line: {text[:200]!r}"
        return (
            "refused"
            if "case" in text or "servo of" in text or kind == "overrides"
            else f"the file is not named: {text[:200]}"
        )
    return f"silent: {silent}" if silent else "fine"
