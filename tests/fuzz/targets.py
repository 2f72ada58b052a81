"""What is done with a damaged file: read, and used as far as the program uses it before any long work."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from dexsim.actuator.table import ServoTable
from dexsim.calibration.file import Calibration
from dexsim.cli import start
from dexsim.deploy import bundle
from dexsim.errors import UserError
from dexsim.gap.read import channels, inputs
from dexsim.paths import CONFIGS
from dexsim.recording import metadata, read
from dexsim.recording.mechanism import Mechanism
from dexsim.tactile import file as tactile_file

from . import corpus

MODEL = """<mujoco><worldbody><body><joint name="a" axis="0 1 0" range="-1 1" limited="true"/>
 <geom size=".02" mass=".1" pos="0 0 -.1"/>
<body pos="0 0 -.2"><joint name="b" axis="0 1 0"/><geom size=".02" mass=".1" pos="0 0 -.1"/></body></body></worldbody>
 </mujoco>"""


def recording(path: Path) -> None:
    r = read(path)
    spec = mujoco.MjSpec.from_string(MODEL)
    m = Mechanism(spec, corpus.JOINTS, ServoTable.from_dict(corpus.SERVO), "rig")
    try:
        run = inputs.to_run(read(path, joints=m.joints), m, [])
    except inputs.Unusable:
        return
    model = spec.compile()
    _, out, blind = channels.inspect([run], model, channels.spoiled([r]))
    runs = channels.drop([run], out, [], model)
    if blind:
        runs, _ = inputs.free_air(runs, [], inputs.merged_spans(blind), [], "", "", (0.0, 0.0), inputs.SHORTEST)
    for run in runs:
        run.smooth()
        assert np.isfinite(run.q).all() and np.isfinite(run.cmd).all() and (np.diff(run.t) > 0).all(), (
            "a run that cannot be simulated"
        )


def servo(path: Path) -> None:
    table = ServoTable.load(path)
    table.check_joints(corpus.JOINTS)
    for f in (table.nominal, table.bounds, table.unknown, table.current):
        f(corpus.JOINTS)
    for which in ("loop", "position"):
        table.encoder(which, corpus.JOINTS)
    ServoTable.from_dict(table.to_dict())


def calibration(path: Path) -> None:
    c = Calibration.load(path)
    assert np.isfinite(c.torque_norm(np.ones(12))).all() and np.isfinite(c.normal_force(np.ones((5, 120, 3)))).all()
    Calibration.from_dict(c.to_dict())


def tactile(path: Path) -> None:
    tactile_file.load(path)


def beside(path: Path) -> None:
    """As the metadata file beside a recording."""
    path.rename(path.with_name("case.mcap.yaml"))
    stated, _ = metadata.collect(path.with_name("case.mcap"), {}, {})
    metadata.complete(stated, True, True)


def config(path: Path) -> None:
    from dexsim.recording.attached import fault

    assert "\n" not in fault(path.read_bytes().decode("utf-8", "replace"), "case config")


def checkpoint(path: Path) -> None:
    """Loaded, and its settings completed, as play does before it builds anything."""
    start.for_play([f"checkpoint={path}", "device=cpu"], CONFIGS)


def manifest(path: Path) -> None:
    bundle.load(path)


def overrides(path: Path) -> None:
    """The settings of a training, as far as they are checked before anything heavy begins."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    if any(line.lstrip("+~").startswith(("servo_file", "resume", "tactile_file", "model_file")) for line in lines):
        return
    with contextlib.redirect_stdout(io.StringIO()):
        start.for_train(lines, CONFIGS)


TARGETS: dict[str, Callable[[Path], None]] = {
    "recording": recording,
    "servo": servo,
    "calibration": calibration,
    "tactile": tactile,
    "metadata": beside,
    "config": config,
    "checkpoint": checkpoint,
    "manifest": manifest,
    "overrides": overrides,
}


def verdict(kind: str, path: Path) -> str:
    """"fine", "refused", or what is wrong with how the file was answered."""
    try:
        TARGETS[kind](path)
    except UserError as error:
        text = str(error)
        if "\n" in text:
            return f"more than one line: {text[:200]!r}"
        return (
            "refused"
            if "case" in text or "servo of" in text or kind == "overrides"
            else f"the file is not named: {text[:200]}"
        )
    return "fine"
